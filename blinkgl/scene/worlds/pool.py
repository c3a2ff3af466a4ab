"""Pools of objects and textures, listed by content hash, split into disjoint train and test parts, loaded lazily.

An entry's split depends only on its content: the same file under two names, on two machines, in another order or in a
larger pool is always on the same side. An entry is drawn by first choosing a source (a folder, the primitives, …) with
equal chances and then an entry, so that a thousand patterns do not outweigh six photographs.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.config.primitives import kinds
from blinkgl.config.scene import TEXTURE_KINDS, PoolConfig, TexturesConfig
from blinkgl.errors import AssetError, ConfigError
from blinkgl.machine.extras import install
from blinkgl.scene.geometry.random_primitives import random_primitive, random_primitive_hash
from blinkgl.scene.importing.mesh_files import MESH_SUFFIXES, Asset, dependencies, load_asset
from blinkgl.scene.reading import MAX_BYTES, contents, resolve
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
    """One mesh or texture that can be loaded. ``source`` is the folder or kind of source, ``file`` None for generated
    ones."""

    source_hash: str
    name: str
    source: str
    file: Path | None = None
    kind: str = ""
    index: int = 0


class Cache:
    """What was loaded last, ``limit`` bytes of all pools together: a process that makes sequences of many groups for
    days uses no more memory than one that makes a few."""

    def __init__(self, limit: int):
        self.limit, self.held = limit, 0
        self._kept: OrderedDict[tuple[object, str], tuple[Any, int]] = OrderedDict()

    def __len__(self) -> int:
        return len(self._kept)

    def get(self, key: tuple[object, str], load: Callable[[], Any]) -> Any:
        """Return the stored content of this key, or ``load()``."""
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key][0]
        loaded = load()
        # Measured when it is loaded: textures and meshes are not changed afterwards.
        size = _bytes_of(loaded)
        self._kept[key] = loaded, size
        self.held += size
        # The last one stays whatever its size, since the caller uses it next.
        while self.held > self.limit and len(self._kept) > 1:
            self.held -= self._kept.popitem(last=False)[1][1]
        return loaded


_OF_ALL_POOLS = Cache(256_000_000)


@dataclass
class Pool:
    """Entries in a deterministic order (by source, then hash), and what is needed to load them.

    bad_assets : "error" raises AssetError; "skip" logs it and draws again.   what, where : for messages.
    cache : of what was loaded; default: the process's.
    """

    entries: tuple[Entry, ...]
    load_entry: Callable[[Entry], object]
    test_fraction: float
    where: str
    what: str
    bad_assets: str = "error"
    cache: Cache = field(default=_OF_ALL_POOLS, repr=False)
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
            if split_of(entry.source_hash, self.test_fraction) == split:
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

    def load(self, entry: Entry) -> Any:
        """Return the entry's content, which may be the cache's."""
        return self.cache.get((self._own, entry.source_hash), lambda: self.load_entry(entry))

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
    if isinstance(loaded, Texture):
        return loaded.image.nbytes
    own = sum(a.nbytes for p in loaded.parts for a in (p.mesh.vertices, p.mesh.faces, p.mesh.normals, p.mesh.uvs))
    return own + sum(
        t.image.nbytes
        for t in {id(p.material.texture): p.material.texture for p in loaded.parts}.values()
        if t is not None
    )


def object_pool(config: PoolConfig, base: Path, where: str = "scene.pool", max_texture: int = 1024) -> Pool:
    """Return the pool of primitives and mesh folders. It loads :class:`~blinkgl.scene.importing.mesh_files.Asset`
    objects that are centred on their bounding box and have bounding radius 1. Raises ConfigError for a folder that is
    missing or has no mesh."""
    entries = []
    for kind in kinds("pool") if config.primitives == "all" else config.primitives:
        for index in range(config.variants):
            entries.append(
                Entry(random_primitive_hash(kind, index), f"{kind}-{index}", "primitives", kind=kind, index=index)
            )
    folders = [(resolve(folder, base), f"{where}.folders.{i}", folder) for i, folder in enumerate(config.folders)]
    limit = int(config.max_file_mb * 1e6)
    for folder, at, name in folders:
        entries += _folder_entries(folder, at, name, MESH_SUFFIXES, limit, "mesh", config.bad_assets)

    def load(entry: Entry) -> Asset:
        if entry.file is None:
            # People, flags and fish have their own colours; other primitives get a texture of the pool.
            wears = config.keep_materials and entry.kind in COATS
            material = Material(coat(entry.kind, entry.index)) if wears else Material()
            part = Part(random_primitive(entry.kind, entry.index), material)
            return Asset(entry.name, entry.source_hash, (part,), wears).normalised()
        asset = load_asset(
            entry.file,
            max_faces=config.max_faces,
            max_bytes=limit,
            keep_materials=config.keep_materials,
            max_texture=max_texture,
            source_hash=entry.source_hash,
            up=config.up,
        )
        # The hash decides split and order. A file that changed since it was listed would silently be another scene.
        _same_content(entry, content_hash(contents(entry.file, "mesh", max_bytes=limit), *dependencies(entry.file)))
        return asset.normalised()

    return Pool(_listed(entries), load, config.test_fraction, where, "meshes", config.bad_assets)


def texture_pool(config: TexturesConfig, base: Path, where: str = "scene.textures") -> Pool:
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
                where=f"{where}.photographs",
                value=True,
                accepted=f"run {install('scikit-image')}, or set it to false",
            )
        entries += [Entry(content_hash(file.read_bytes()), name, "photographs", file) for name, file in bundled.items()]
    for i, folder in enumerate(config.folders):
        entries += _folder_entries(
            resolve(folder, base), f"{where}.folders.{i}", folder, IMAGE_SUFFIXES, MAX_BYTES, "image", config.bad_assets
        )

    def load(entry: Entry) -> Texture:
        if entry.file is None:
            return procedural_texture(entry.kind, entry.index, config.max_size)
        data = contents(entry.file, "image")
        _same_content(entry, content_hash(data))
        return Texture(decode_image(data, config.max_size, str(entry.file)), entry.name, entry.source_hash)

    return Pool(_listed(entries), load, config.test_fraction, where, "textures", config.bad_assets)


def _same_content(entry: Entry, found: str) -> None:
    if found != entry.source_hash:
        raise ChangedAsset(entry.file)


def files_below(folder: Path, where: str, given: str, suffixes: tuple[str, ...], what: str) -> list[Path]:
    """Return files with these suffixes, recursively, sorted by name. Raises ConfigError when the folder is missing or
    has none."""
    if not folder.is_dir():
        raise ConfigError(
            "is not a folder" if folder.exists() else "no such folder",
            where=where,
            value=given,
            accepted=f"a folder of {what}",
        )
    try:
        files = sorted(
            p for p in folder.rglob("*") if p.suffix.lower() in suffixes and p.is_file() and not p.name.startswith(".")
        )
    except OSError as error:
        raise ConfigError(f"cannot read the folder: {error.strerror or error}", where=where, value=given) from None
    if not files:
        raise ConfigError(
            f"the folder holds no {what}", where=where, value=given, accepted="files of " + " ".join(suffixes)
        )
    if len(files) > _MAX_FILES:
        raise ConfigError(f"the folder holds more than {_MAX_FILES} {what}", where=where, value=given)
    return files


def _folder_entries(
    folder: Path, where: str, given: str, suffixes, limit: int, what: str, bad_assets: str
) -> Iterable[Entry]:
    entries = []
    for file in files_below(folder, where, given, suffixes, "meshes" if what == "mesh" else "images"):
        try:
            data = contents(file, what, max_bytes=limit)
            digest = content_hash(data, *dependencies(file, data))
        except AssetError:
            if bad_assets == "error":
                raise
            continue
        entries.append(Entry(digest, str(file.relative_to(folder)), given, file))
    return entries


def _listed(entries: Iterable[Entry]) -> tuple[Entry, ...]:
    """Return the entries without repeated content inside a source, sources in the order of the YAML, each sorted by
    hash."""
    sources: dict[str, dict[str, Entry]] = {}
    for entry in entries:
        sources.setdefault(entry.source, {}).setdefault(entry.source_hash, entry)
    return tuple(entry for listed in sources.values() for _, entry in sorted(listed.items()))
