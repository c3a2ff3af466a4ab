"""Instruction set of this CPU."""

from __future__ import annotations

from pathlib import Path

_BF16 = {"avx512_bf16": "AVX-512 BF16", "amx_bf16": "AMX", "bf16": "Arm BF16"}
"""Names of the kernel's flags, x86 and Arm."""


def cpu_field(*names: str) -> str:
    """Return the kernel's value for the first core under the first of ``names`` that exists, e.g. ``vendor_id``; an
    empty string where there is no such file."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            name, _, value = line.partition(":")
            if name.strip() in names:
                return value.strip()
    except OSError:
        pass
    return ""


def cpu_flags() -> frozenset[str]:
    """Return the features of the first core by the names of Linux (x86: flags; Arm: Features). Features that a virtual
    machine hides are missing; mathematics libraries do not see them either."""
    return frozenset(cpu_field("flags", "Features").split())


def bf16_instructions() -> str:
    """Return the instructions that multiply bfloat16 here, e.g. "AVX-512 BF16, AMX"; "" where there are none: it is
    then emulated, 45 to 80 times slower than fp32."""
    flags = cpu_flags()
    return ", ".join(text for flag, text in _BF16.items() if flag in flags)
