"""What this processor's instruction set offers."""

from __future__ import annotations

from pathlib import Path

_BF16 = {"avx512_bf16": "AVX-512 BF16", "amx_bf16": "AMX", "bf16": "Arm BF16"}
"""Names of the kernel's flags, x86 and Arm."""


def cpu_flags(path: str = "/proc/cpuinfo") -> frozenset[str]:
    """The kernel's names of the first core's features; empty where there is no such file. What a virtual machine hides
    is not there, which is what the mathematics libraries see, too."""
    try:
        for line in Path(path).read_text(encoding="utf-8", errors="replace").splitlines():
            name, _, values = line.partition(":")
            if name.strip() in ("flags", "Features"):
                return frozenset(values.split())
    except OSError:
        pass
    return frozenset()


def bf16_instructions() -> str:
    """What multiplies bfloat16 here, e.g. "AVX-512 BF16, AMX"; "" where nothing does: it is then
    emulated, 45 to 80 times slower than fp32."""
    flags = cpu_flags()
    return ", ".join(text for flag, text in _BF16.items() if flag in flags)
