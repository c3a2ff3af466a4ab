"""Pools of objects and textures, listed by content hash, split into disjoint train and test parts, loaded lazily.

An entry's split depends only on its shape: the same mesh file under two names, with other textures, on two machines, in
another order or in a larger pool is always on the same side. An entry is drawn by first choosing a source (a folder,
the primitives, …) with equal chances and then an entry, so that a thousand patterns do not outweigh six photographs.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.config.primitives import kinds
from blinkgl.config.scene import TEXTURE_KINDS, PoolConfig, TexturesConfig
from blinkgl.errors import AssetError, ConfigError
from blinkgl.machine.extras import install
from blinkgl.scene.geometry.random_primitives import random_primitive, random_primitive_hash
from blinkgl.scene.importing.mesh_files import (
    MESH_SUFFIXES,
    Asset,
    Identity,
    bytes_of,
    check_header,
    identity_of,
    load_asset,
)
from blinkgl.scene.reading import RECENT, Cache, contents, resolve
from blinkgl.scene.surfaces.coats import COATS, coat
from blinkgl.scene.surfaces.images import IMAGE_SUFFIXES, content_hash, decode_image, photographs
from blinkgl.scene.surfaces.textures import procedural_hash, procedural_texture
from blinkgl.scene.types import Material, Part, Texture

SPLITS = ("train", "test")
_MAX_REDRAWS = 50
_MAX_FILES = 1_000_000


def split_of(source_hash: str, test_fraction: float) -> str:
    """Return 'train' or 'test', from the hash alone. Raising the fraction moves entries only to 'test'."""
    # 13 hexadecimal digits, 52 bits of the hash, as a fraction of their range.
    return "test" if int(source_hash[:13], 16) < test_fraction * 16**13 else "train"


class ChangedAsset(AssetError):
    """A file has changed since the pool was listed: the drawn scenes would depend on when it was read."""

    def __init__(self, file: Path):
        super().__init__(
            "the file has changed while it was in use", where=str(file), accepted="the file as it was, or a new run"
        )


@dataclass(frozen=True)
class Entry:
    """One mesh or texture that can be loaded.

    source_hash : its identity, of everything that is read for it.   source : the folder or kind of source.   file :
    None for generated ones.   border : folder that its files lie below.   shape : hash of the mesh alone, which
    decides split and order; "": ``source_hash``.   beside : hash of each other file that is read for it, by name."""

    source_hash: str
    name: str
    source: str
    file: Path | None = None
    kind: str = ""
    index: int = 0
    border: Path | None = None
    shape: str = ""
    beside: tuple[tuple[str, str], ...] = ()


@dataclass
class Pool:
    """Entries in a deterministic order (by source, then hash), and what is needed to load them.

    bad_assets : "error" raises AssetError; "skip" logs it and draws again.   what, where : for messages.
    cache : of what was loaded; default: the process's.   notes : on what its folders hold and it does not.
    """

    entries: tuple[Entry, ...]
    load_entry: Callable[[Entry], object]
    test_fraction: float
    where: str
    what: str
    bad_assets: str = "error"
    notes: tuple[str, ...] = ()
    cache: Cache = field(default=RECENT, repr=False)
    _own: object = field(default_factory=object, repr=False)  # identity: two pools may load the same file in two ways
    _sides: dict[str, dict[str, tuple[Entry, ...]]] = field(default_factory=dict, repr=False)

    def split(self, split: str) -> dict[str, tuple[Entry, ...]]:
        """Return source -> its entries on this side, without empty sources. Raises ConfigError when nothing is left."""
        if split in self._sides:
            return self._sides[split]
        if split not in SPLITS:
            raise ConfigError("unknown split", value=split, accepted="train or test")
        sides: dict[str, list[Entry]] = {}
        for entry in self.entries:
            if split_of(entry.shape or entry.source_hash, self.test_fraction) == split:
                sides.setdefault(entry.source, []).append(entry)
        if not sides:
            if not self.entries:
                raise ConfigError(
                    f"the pool of {self.what} is empty",
                    where=self.where,
                    accepted=f"at least one source of {self.what}",
                )
            raise ConfigError(
                f"none of the {len(self.entries)} {self.what} falls to split '{split}'",
                where=f"{self.where}.test_fraction",
                value=self.test_fraction,
                accepted="another fraction, or a larger pool",
            )
        self._sides[split] = {source: tuple(entries) for source, entries in sides.items()}
        return self._sides[split]

    def load(self, entry: Entry) -> object:
        """Return the entry's content, which may be the cache's."""
        return self.cache.get((self._own, entry.source_hash), lambda: self.load_entry(entry), _bytes_of)

    def draw(self, rng: np.random.Generator, split: str, log: list[str] | None = None) -> Any:
        """Return a random entry's content. The number of draws from ``rng`` does not depend on the cache."""
        sides = self.split(split)
        sources = list(sides)
        for _ in range(_MAX_REDRAWS):
            # First a source, then one of its entries: a folder of thousands does not outweigh a few primitives.
            entries = sides[sources[int(rng.integers(len(sources)))]]
            entry = entries[int(rng.integers(len(entries)))]
            try:
                return self.load(entry)
            except ChangedAsset:  # skipping it would silently make another scene
                raise
            except AssetError as error:
                if self.bad_assets == "error":
                    raise
                if log is not None:
                    log.append(f"skipped: {error}")
        raise AssetError(f"{_MAX_REDRAWS} {self.what} drawn in a row are unusable", where=self.where)


def _bytes_of(loaded: Texture | Asset) -> int:
    return loaded.image.nbytes if isinstance(loaded, Texture) else bytes_of(loaded)


def object_pool(config: PoolConfig, base: Path, max_texture: int = 1024) -> Pool:
    """Return the pool of primitives and mesh folders. It loads :class:`~blinkgl.scene.importing.mesh_files.Asset`
    objects that are centred on their bounding box and have bounding radius 1. Raises ConfigError for a folder that is
    missing or has no mesh."""
    entries = [
        Entry(random_primitive_hash(kind, index), f"{kind}-{index}", "primitives", kind=kind, index=index)
        for kind in (kinds("pool") if config.primitives == "all" else config.primitives)
        for index in range(config.variants)
    ]
    limit = int(config.max_file_mb * 1e6)
    notes: list[str] = []
    dressed = config.keep_materials is not False

    def identity(file: Path, border: Path) -> Identity:
        data = contents(file, "mesh", max_bytes=limit)
        check_header(file, data, config.max_faces)
        return identity_of(file, data, border, dressed)

    for i, folder in enumerate(config.folders):
        listed = resolve(folder, base), f"scene.pool.folders.{i}", folder, MESH_SUFFIXES, "meshes"
        entries += _folder_entries(*listed, config.bad_assets, identity, notes)

    def load(entry: Entry) -> Asset:
        if entry.file is None:
            # People, flags and fish have their own colours; other primitives get a texture of the pool.
            wears = config.keep_materials is True and entry.kind in COATS
            material = Material(coat(entry.kind, entry.index)) if wears else Material()
            part = Part(random_primitive(entry.kind, entry.index), material)
            return Asset(entry.name, entry.source_hash, (part,), wears).normalised()
        limits = {"max_faces": config.max_faces, "max_bytes": limit, "max_texture": max_texture, "up": config.up}
        known = {"source_hash": entry.source_hash, "border": entry.border}
        asset = load_asset(entry.file, keep_materials=dressed, **limits, **known)
        # Whether a file chose its looks is known only once it is read with them.
        if config.keep_materials == "auto" and not asset.has_looks:
            asset = load_asset(entry.file, keep_materials=False, **limits, **known)
        if config.keep_materials == "auto":
            worn = "its own" if asset.has_materials else "one of the world, since it has none of its own"
            looks = f"{asset.name}: its look is {worn} (scene.pool.keep_materials: auto)"
            asset = replace(asset, log=(*asset.log, looks))
        # A file that changed since it was listed would silently be another scene.
        _same_content(entry, identity(entry.file, entry.border or entry.file.parent))
        return asset.normalised()

    return Pool(
        entries=_listed(entries),
        load_entry=load,
        test_fraction=config.test_fraction,
        where="scene.pool",
        what="meshes",
        bad_assets=config.bad_assets,
        notes=tuple(notes),
    )


def texture_pool(config: TexturesConfig, base: Path) -> Pool:
    """Return the pool of procedural textures, scikit-image's photographs and image folders. It loads
    :class:`~blinkgl.scene.types.Texture`."""
    kinds = TEXTURE_KINDS if config.procedural is True else config.procedural or ()
    entries = [
        Entry(procedural_hash(kind, index), f"{kind}-{index}", "procedural", kind=kind, index=index)
        for kind in kinds
        for index in range(config.variants)
    ]
    if config.photographs:
        bundled = photographs()
        if not bundled:
            raise ConfigError(
                "scikit-image's photographs are not installed",
                where="scene.textures.photographs",
                value=True,
                accepted=f"run {install('scikit-image')}, or set it to false",
            )
        entries += [Entry(content_hash(file.read_bytes()), name, "photographs", file) for name, file in bundled.items()]
    notes: list[str] = []

    def identity(file: Path, border: Path) -> Identity:
        digest = content_hash(contents(file, "image"))
        return Identity({}, digest, digest)

    for i, folder in enumerate(config.folders):
        listed = resolve(folder, base), f"scene.textures.folders.{i}", folder, IMAGE_SUFFIXES, "images"
        entries += _folder_entries(*listed, config.bad_assets, identity, notes)

    def load(entry: Entry) -> Texture:
        if entry.file is None:
            return procedural_texture(entry.kind, entry.index, config.max_size)
        data = contents(entry.file, "image")
        _same_content(entry, Identity({}, content_hash(data), content_hash(data)))
        return Texture(decode_image(data, config.max_size, str(entry.file)), entry.name, entry.source_hash)

    return Pool(
        entries=_listed(entries),
        load_entry=load,
        test_fraction=config.test_fraction,
        where="scene.textures",
        what="textures",
        bad_assets=config.bad_assets,
        notes=tuple(notes),
    )


def _same_content(entry: Entry, now: Identity) -> None:
    """Raise ChangedAsset, which names the file, where one that is read for an entry is another than was listed."""
    if entry.file is not None and now.whole != entry.source_hash:
        before = dict(entry.beside)
        other = sorted(n for n in before.keys() | now.files.keys() if before.get(n) != now.files.get(n))
        raise ChangedAsset(entry.file.parent / other[0] if other else entry.file)


def files_below(
    folder: Path, where: str, given: str, suffixes: tuple[str, ...], what: str, notes: list[str] | None = None
) -> list[Path]:
    """Return files with these suffixes, recursively, sorted by name. Links are followed, each folder is searched once;
    hidden files and folders are left out.   notes : gets a line that counts those. Raises ConfigError when the folder
    is missing or has none."""
    if not folder.is_dir():
        raise ConfigError(
            "is not a folder" if folder.exists() else "no such folder",
            where=where,
            value=given,
            accepted=f"a folder of {what}",
        )
    hidden: list[str] = []
    try:
        files = sorted(
            p for p in _walk(folder, hidden) if p.suffix.lower() in suffixes and p.is_file() and p.name[0] != "."
        )
    except OSError as error:
        raise ConfigError(f"cannot read the folder: {error.strerror or error}", where=where, value=given) from None
    if not files:
        raise ConfigError(
            f"the folder holds no {what}", where=where, value=given, accepted="files of " + " ".join(suffixes)
        )
    if len(files) > _MAX_FILES:
        raise ConfigError(f"the folder holds more than {_MAX_FILES} {what}", where=where, value=given)
    if hidden and notes is not None:
        names = ", ".join(sorted(hidden)[:3]) + (", …" if len(hidden) > 3 else "")
        notes.append(f"{where}: {len(hidden)} hidden files or folders are left out ({names})")
    return files


def _walk(folder: Path, hidden: list[str]) -> Iterator[Path]:
    """Yield the files below a folder: of its own folders, then of those that links lead to. hidden : gets the names of
    files and folders that begin with a dot."""
    seen, waiting = set(), [folder]
    while waiting:
        for here, folders, names in os.walk(waiting.pop(0), onerror=_raise):
            # Links may lead round in circles, and to one folder by many names: device and inode are its identity.
            if (number := (os.stat(here).st_dev, os.stat(here).st_ino)) in seen:
                folders.clear()
                continue
            seen.add(number)
            hidden += [name for name in (*folders, *names) if name.startswith(".")]
            folders[:] = sorted(name for name in folders if not name.startswith("."))
            waiting += [Path(here, name) for name in folders if os.path.islink(os.path.join(here, name))]
            yield from (Path(here, name) for name in names)


def _raise(error: OSError) -> None:
    raise error


def _folder_entries(
    folder: Path,
    where: str,
    given: str,
    suffixes: tuple[str, ...],
    what: str,
    bad_assets: str,
    identity: Callable[[Path, Path], Identity],
    notes: list[str],
) -> Iterable[Entry]:
    entries, unusable = [], []
    for file in files_below(folder, where, given, suffixes, what, notes):
        # A linked folder is its own border: a user has put it there, and nothing leads further.
        border = next(p for p in file.parents if p == folder or p.is_symlink())
        try:
            identified = identity(file, border)
        except AssetError as error:
            if bad_assets == "error":
                raise
            unusable.append(f"{file.name}: {error.problem}")
            continue
        name = str(file.relative_to(folder))
        beside = tuple(identified.files.items())
        entries.append(Entry(identified.whole, name, given, file, border=border, shape=identified.shape, beside=beside))
    if unusable:
        names = "; ".join(unusable[:3]) + ("; …" if len(unusable) > 3 else "")
        notes.append(f"{where}: {len(unusable)} unusable files are left out ({names})")
    return entries


def _listed(entries: Iterable[Entry]) -> tuple[Entry, ...]:
    """Return the entries without repeated content inside a source, sources in the order of the YAML, each sorted by
    hash."""
    sources: dict[str, dict[str, Entry]] = {}
    for entry in entries:
        sources.setdefault(entry.source, {}).setdefault(entry.source_hash, entry)
    return tuple(
        entry
        for listed in sources.values()
        for entry in sorted(listed.values(), key=lambda e: (e.shape, e.source_hash))
    )
