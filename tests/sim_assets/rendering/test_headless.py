"""The choice of the OpenGL backend, in interpreters of their own."""

import os
import subprocess
import sys

import pytest

from sim_assets.rendering import headless
from sim_assets.rendering.headless import GraphicsError, choose_backend, require_rendering

RENDER = """
from sim_assets.rendering.headless import gl_context, mujoco
import os
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>")
context = gl_context(32, 32)
context.make_current()
context.free()
print(os.environ["MUJOCO_GL"])
"""


def run(code, **environment):
    env = {k: v for k, v in os.environ.items() if k != "MUJOCO_GL"} | environment
    return subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, timeout=120)


def test_an_unset_backend_is_chosen_even_after_mujoco_was_imported():
    done = run("import mujoco\n" + RENDER)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() in ("egl", "osmesa")
    assert "Exception ignored" not in done.stderr


def test_the_user_has_the_first_word(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    assert choose_backend() == "osmesa"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems render without a choice")
def test_without_any_backend_physics_stays_and_rendering_says_what_to_install(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL")
    monkeypatch.setattr(headless, "egl_works", lambda: False)
    monkeypatch.setattr(headless, "osmesa_works", lambda: False)
    monkeypatch.setattr(headless.importlib, "reload", lambda module: module)
    assert choose_backend() == ""
    with pytest.raises(GraphicsError, match="apt-get install libegl1"):
        require_rendering()


def test_a_warning_of_mujoco_is_logged_and_leaves_no_file(tmp_path, monkeypatch, caplog):
    from sim_assets.rendering.headless import mujoco

    monkeypatch.chdir(tmp_path)
    xml = '<mujoco><worldbody><body><freejoint/><geom size=".1"/></body></worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qvel[:] = float("nan")
    mujoco.mj_step(model, data)
    assert "MuJoCo: Nan, Inf or huge value in QVEL" in caplog.text
    assert list(tmp_path.iterdir()) == []
