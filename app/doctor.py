"""``nodeslam doctor``: check this machine, with a remedy for whatever is missing."""

from __future__ import annotations

import importlib.metadata
import platform
import re
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rich.markup import escape
from rich.table import Table

from app.options import DoctorOptions
from app.runs.report import Report, package_version
from app.runs.run_folder import RunFolder
from app.screen import Screen
from perception.errors import PerceptionError, install_hint
from perception.io.weights import CHECKSUMS_FILE, WEIGHTS_DIRECTORY, expected_checksum, weights_checksum
from sim_assets.processes import probe

Status = Literal["ok", "missing", "optional"]

ROOT = Path(__file__).parents[1]
WEIGHTS = {  # weights file without extension: the command that trains it
    "shape": "nodeslam train shape",
    "detector": "nodeslam train detector",
    "scene": "nodeslam train detector",
    "yaw": "nodeslam train yaw",
    "pose": "nodeslam train pose",
    "axis": "nodeslam train axis",
    "verifier": "nodeslam train verifier",
}
NEEDED = (
    "numpy", "scipy", "torch", "onnxruntime", "warp-lang", "safetensors", "trimesh", "scikit-image", "tyro",
    "rich",
)  # fmt: skip
SIMULATOR = ("mujoco", "mink", "daqp", "ruckig", "coacd")
OPTIONAL = {"open3d-cpu": "eval", "tensorboard": "train", "transformers": "hf", "ray": "cluster"}
PROBE_SECONDS = 60
_PROBE = """
import os, sys
from sim_assets.rendering.headless import mujoco
scene = '<mujoco><worldbody><light pos="0 0 2"/><geom size=".1"/></worldbody></mujoco>'
model = mujoco.MjModel.from_xml_string(scene)
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 48, 64) as renderer:
    renderer.update_scene(data)
    image = renderer.render()
print(os.environ["MUJOCO_GL"])
sys.exit(0 if image.any() else 3)
"""


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    Attributes:
        name: Subject of the check.
        status: "ok", "missing" if it is required, or "optional".
        found: Version or error.
        remedy: What to do if the status is not "ok".
    """

    name: str
    status: Status
    found: str
    remedy: str = ""


def run(options: DoctorOptions, screen: Screen) -> Report:
    """Run all checks of the machine, or of an arm; successful if no requirement is missing."""
    if options.robot is not None:
        from app.robots.doctor import run_robot_doctor

        return run_robot_doctor(options, options.robot, screen)
    begin = time.perf_counter()
    folder = RunFolder.create(options, "doctor")
    findings = examine()
    missing = [finding.name for finding in findings if finding.status == "missing"]
    report = Report(
        command="doctor",
        seed=options.seed,
        success=not missing,
        reason=f"missing: {', '.join(missing)}" if missing else "everything that is needed is here",
        timings={"total": time.perf_counter() - begin},
        metrics={"findings": [vars(finding) for finding in findings]},
    )
    folder.write_report(report)
    screen.show(_table(findings))
    screen.show(escape(report.reason))
    return report


def examine() -> list[Finding]:
    """Return all findings, the basic ones first."""
    findings = [
        Finding("nodeslam", "ok", package_version()),
        Finding("python", "ok" if sys.version_info >= (3, 11) else "missing", platform.python_version()),
    ]
    lock = locked_versions()
    findings += [check_version(name, lock, "missing", "make setup") for name in NEEDED]
    findings += [check_version(name, lock, "missing", install_hint("sim")) for name in SIMULATOR]
    findings += [
        check_version(name, lock, "optional", install_hint(extra)) for name, extra in OPTIONAL.items()
    ]
    return [*findings, check_gl(), check_filament(), check_cuda(), *(check_weights(name) for name in WEIGHTS)]


def locked_versions(path: Path = ROOT / "requirements.lock") -> dict[str, str]:
    """Return the tested versions by name; empty without a lock file."""
    if not path.is_file():
        return {}
    pairs = re.findall(r"^([\w.-]+)==([\w.+!-]+)", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {_canonical(name): version for name, version in pairs}


def check_version(name: str, lock: dict[str, str], absent: Status, remedy: str) -> Finding:
    """Check whether a distribution is installed, and whether in the tested version."""
    try:
        version = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return Finding(name, absent, "not installed", remedy)
    if name == "mujoco" and version == "4.0.0":
        return Finding(
            name, "missing", "4.0.0 has a wrong Newton Hessian", "pip install 'mujoco>=3.17,!=4.0.0'"
        )
    tested = lock.get(_canonical(name), version.split("+")[0])
    differs = tested != version.split("+")[0]  # +cpu and the like name a build
    return Finding(name, "ok", version + (f" (tested with {tested})" if differs else ""))


def check_gl(program: str = _PROBE) -> Finding:
    """Render a small image in another process, since a broken OpenGL terminates its process."""
    remedy = "apt-get install libegl1 libgl1 libgl1-mesa-dri (or libosmesa6 and MUJOCO_GL=osmesa)"
    try:
        ended = probe(program, PROBE_SECONDS)
    except subprocess.TimeoutExpired:
        return Finding("rendering", "missing", f"no image within {PROBE_SECONDS} s", remedy)
    if ended.returncode == 0:
        return Finding("rendering", "ok", f"MUJOCO_GL={ended.stdout.strip()}")
    last = (ended.stderr.strip().splitlines() or [f"exit code {ended.returncode}"])[-1]
    return Finding("rendering", "missing", last[:100], remedy)


def check_filament() -> Finding:
    """Check the second renderer, which only ``evaluate detection`` requires."""
    try:
        from sim_assets.rendering.filament import filament_fault
    except ImportError as error:
        return Finding("filament", "optional", str(error)[:100], install_hint("sim"))
    fault = filament_fault()
    if fault:
        return Finding("filament", "optional", fault, "apt-get install libvulkan1 mesa-vulkan-drivers")
    return Finding("filament", "ok", "Vulkan in software")


def check_cuda() -> Finding:
    """Check whether torch finds a CUDA device; it is optional."""
    try:
        import torch

        if torch.cuda.is_available():
            return Finding("cuda", "ok", torch.cuda.get_device_name(0))
        return Finding(
            "cuda", "optional", "no device; the CPU is enough", "a CUDA build of torch and a driver"
        )
    except ImportError as error:
        return Finding("cuda", "optional", str(error), "make setup")


def check_weights(name: str, folder: Path = WEIGHTS_DIRECTORY) -> Finding:
    """Whether a weights file exists and has the checksum that ``SHA256SUMS`` beside it lists."""
    weights = folder / f"{name}.safetensors"
    remedy = f"git checkout perception/weights/{weights.name}, or {WEIGHTS[name]}"
    if not weights.is_file():
        return Finding(f"weights: {name}", "missing", "no file", remedy)
    try:
        expected = expected_checksum(weights)
    except PerceptionError as error:
        return Finding(f"weights: {name}", "missing", str(error), remedy)
    checksum = weights_checksum(weights)
    if expected is None:
        return Finding(f"weights: {name}", "ok", f"sha256 {checksum[:12]}..., no {CHECKSUMS_FILE} beside it")
    if checksum != expected:
        return Finding(f"weights: {name}", "missing", f"checksum differs from {CHECKSUMS_FILE}", remedy)
    return Finding(f"weights: {name}", "ok", f"sha256 {checksum[:12]}...")


def _canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _table(findings: list[Finding]) -> Table:
    table = Table(title="nodeslam doctor", title_justify="left", show_edge=False)
    for heading in ("", "what", "found", "what to do"):
        table.add_column(heading)
    marks = {"ok": "[green]✓[/green]", "missing": "[red]✗[/red]", "optional": "[yellow]–[/yellow]"}
    for finding in findings:
        remedy = finding.remedy if finding.status != "ok" else ""
        table.add_row(marks[finding.status], escape(finding.name), escape(finding.found), escape(remedy))
    return table
