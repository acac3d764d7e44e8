"""The processors that kernels are compiled for. `setup.py` loads this file by its path."""

import os
import platform

# What an x86-64 processor of level 3 has (System V ABI, x86-64-v3), by the names of /proc/cpuinfo.
LEVEL_3 = "x86-64-v3"
_FLAGS = {"abm", "avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "movbe"}
CPUINFO = "/proc/cpuinfo"
_CPUINFO_BYTES = 8192  # the flags of the first processor; hundreds may follow


def common_target() -> str | None:
    """Return LLVM's name of the processors that wheels are made for. None: this one is older.

    Then, and where the user has set NUMBA_CPU_NAME, kernels are compiled for this machine.
    """
    if platform.machine() != "x86_64" or os.environ.get("NUMBA_CPU_NAME"):
        return None
    try:
        with open(CPUINFO, encoding="ascii", errors="replace") as file:
            lines = file.read(_CPUINFO_BYTES).splitlines()
    except OSError:
        return None
    flags = next((line for line in lines if line.startswith("flags")), "")
    return LEVEL_3 if set(flags.split()) >= _FLAGS else None
