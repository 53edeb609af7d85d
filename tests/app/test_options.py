"""Names, defaults and help texts of the options: the interface that scripts rely on."""

import subprocess
import sys
from dataclasses import MISSING, fields, is_dataclass

import pytest

from app.cli import HANDLERS, parse
from app.options import COMMANDS, METHODS, VARIANTS

COMMON = {"seed", "out", "device", "quiet", "json"}
CELL = COMMON | {"objects", "object_meshes", "robot", "box", "depth_noise"}
TASK = CELL | {"shapes"}
RUN_TASK = TASK | {"host", "port", "view", "video"}
NAMES = {
    "pack": RUN_TASK,
    "sort": RUN_TASK,
    "scan": CELL | {"video"},
    "reconstruct": COMMON | {"scan", "detector"},
    "convert": COMMON | {"source", "images", "camera"},
    "ar": COMMON | {"run", "drops", "seconds"},
    "export": COMMON | {"run", "format"},
    "slam": COMMON | {"sequence", "objects_only"},
    "train": COMMON | {"network", "epochs", "meshes", "tensorboard"},
    "evaluate": TASK
    | {
        "what",
        "images",
        "renderer",
        "views",
        "methods",
        "scenes",
        "variants",
        "frames",
        "short_runs",
        "faults",
    }
    | {"task", "episodes", "workers", "resume", "ray"},
    "bench": COMMON | {"scan", "repeats"},
    "view": TASK | {"host", "port", "run", "task", "html"},
    "doctor": COMMON | {"robot"},
    "robot": COMMON | {"action", "arm", "hand", "mount", "body"},
}


def test_every_command_has_options_and_a_handler():
    assert set(COMMANDS) == set(HANDLERS) >= set(NAMES)


@pytest.mark.parametrize("command", NAMES)
def test_option_names(command):
    kind = COMMANDS[command]
    assert is_dataclass(kind) and {field.name for field in fields(kind)} >= NAMES[command]


def test_defaults():
    pack = parse(["pack"])
    assert (pack.seed, pack.out, pack.device, pack.quiet, pack.json) == (0, None, "auto", False, False)
    assert (pack.objects, pack.box, pack.robot) == ("6", "0.34,0.30,0.08", "panda")
    assert (pack.depth_noise, pack.shapes, pack.object_meshes) == ("gaussian", "nodeslam", None)
    assert (pack.host, pack.port, pack.view, pack.video) == ("127.0.0.1", None, False, False)
    evaluate = parse(["evaluate", "tasks"])
    assert (evaluate.task, evaluate.episodes, evaluate.workers, evaluate.resume) == ("pack", 20, 1, False)
    assert evaluate.views == (1, 2, 3) and evaluate.methods == METHODS and evaluate.variants == VARIANTS


def test_options_are_immutable():
    with pytest.raises(AttributeError):
        parse(["pack"]).seed = 1


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_has_a_help_text(command, capsys):
    with pytest.raises(SystemExit):
        parse([command, "--help"])
    text = " ".join(capsys.readouterr().out.split())
    for field in fields(COMMANDS[command]):
        option = f"--{field.name.replace('_', '-')}"
        positional = field.default is MISSING or field.name in ("run",)
        assert option in text or positional, option
    assert (COMMANDS[command].__doc__ or "").split()[0] in text


def test_help_loads_nothing_heavy():
    code = """
import sys
from app.cli import run
run(["--help"])
heavy = {"torch", "mujoco", "warp", "cv2", "scipy", "viser"} & set(sys.modules)
sys.exit(str(heavy) if heavy else 0)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "{pack,sort,scan," in done.stdout
