"""Which number format is fast here: `--dtype auto` looks at the machine, nothing assumes one.

On a CPU bf16 helps only with AVX-512 BF16 or AMX; on an AVX2-only CPU it is 15 times slower than fp32 (measured).
"""

import platform
from pathlib import Path

import torch

from unirender.errors import UnirenderError

_DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}


def cpu_has_bf16() -> bool:
    """Whether this CPU multiplies bf16 in hardware (Linux x86-64 only: elsewhere nothing is claimed)."""
    cpuinfo = Path("/proc/cpuinfo")
    if platform.machine() not in {"x86_64", "AMD64"} or not cpuinfo.exists():
        return False
    flags = next((line for line in cpuinfo.read_text().splitlines() if line.startswith("flags")), "").split()
    return "avx512_bf16" in flags or "amx_bf16" in flags


def resolve_device(name: str) -> torch.device:
    """`auto` is CUDA, else MPS, else the CPU.

    Raises:
        UnirenderError: the named device is not available here.
    """
    available = {"cpu": True, "cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    if name == "auto":
        name = next(kind for kind in ("cuda", "mps", "cpu") if available[kind])
    if not available.get(name, False):
        usable = ", ".join(kind for kind, here in available.items() if here)
        raise UnirenderError(f"device: {name} is not available here, expected one of: auto, {usable}")
    return torch.device(name)


def resolve_dtype(name: str, device: torch.device) -> torch.dtype:
    """`auto` is bf16 where the device multiplies it in hardware, else fp32.

    Raises:
        UnirenderError: an unknown name.
    """
    if name == "auto":
        if device.type == "cuda":
            return torch.bfloat16 if torch.cuda.is_bf16_supported(including_emulation=False) else torch.float32
        return torch.bfloat16 if device.type == "cpu" and cpu_has_bf16() else torch.float32
    if name not in _DTYPES:
        raise UnirenderError(f"dtype: got {name!r}, expected one of: auto, {', '.join(_DTYPES)}")
    return _DTYPES[name]
