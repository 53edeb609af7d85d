"""Description of the machine on which times are measured."""

from __future__ import annotations

import os
import platform
import re
from importlib.metadata import version
from pathlib import Path
from typing import Any

from app.runs.report import package_version

LIBRARIES = ("numpy", "scipy", "torch", "onnxruntime", "warp-lang")


def describe_machine(device: str) -> dict[str, Any]:
    """Return processor, number of cores, load, accelerator, and versions of libraries."""
    import torch

    return {
        "processor": _processor(),
        "cores": os.cpu_count() or 1,
        "load": round(os.getloadavg()[0], 2),
        "cuda": torch.cuda.get_device_name(0) if device == "cuda" else None,
        "python": platform.python_version(),
        "nodeslam": package_version(),
        **{name: version(name) for name in LIBRARIES},
    }


def _processor(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """Return the processor's model name, or Python's description of it where there is no cpuinfo."""
    try:
        found = re.search(r"^model name\s*:\s*(.+)$", cpuinfo.read_text(encoding="utf-8"), re.MULTILINE)
    except OSError:
        found = None
    return found.group(1) if found else platform.processor() or platform.machine()
