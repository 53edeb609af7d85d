"""The physically based renderer: what it shows agrees with the classic one; without Vulkan a clear line."""

import numpy as np
import pytest

from sim_assets.rendering import filament
from sim_assets.rendering.camera import OffscreenRenderer
from sim_assets.rendering.filament import FilamentRenderer, require_filament
from sim_assets.rendering.headless import GraphicsError, mujoco

SCENE = """<mujoco><visual><map znear="0.01"/></visual><worldbody>
<light pos="0 0 3" dir="0 0 -1"/><camera name="c" pos="0.2 -1 0.6" xyaxes="1 0.2 0 0 0.5 1" fovy="50"/>
<geom type="plane" size="5 5 .1" rgba="0.9 0.9 0.9 1"/>
<body pos="0.1 0.2 0.15"><geom type="box" size="0.1 0.1 0.15" rgba="0.9 0.05 0.05 1"/></body>
</worldbody></mujoco>"""


def test_both_renderers_see_the_box_in_the_same_place(capfd):
    if filament.filament_fault():
        pytest.skip(f"no Filament here: {filament.filament_fault()}")
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = FilamentRenderer(model)
    image = renderer.color(data, "c", 160, 120).astype(int)
    red = image[..., 0] > 1.6 * image[..., 1]
    classic = OffscreenRenderer(model)
    box = classic.depth_and_ids(data, "c", 160, 120)[1] == 1
    assert box.sum() > 200
    assert (red & box).sum() / (red | box).sum() > 0.9
    again = renderer.color(data, "c", 160, 120).astype(int)
    assert np.abs(again - image).mean() < 1  # it dithers
    renderer.close()
    classic.close()
    assert capfd.readouterr().out == ""  # its engine tells stories, but standard output is for reports


def test_without_vulkan_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr(filament, "filament_fault", lambda: "no usable Vulkan driver")
    with pytest.raises(GraphicsError, match="apt-get install libvulkan1 mesa-vulkan-drivers"):
        require_filament()


def test_a_probe_that_dies_is_a_fault(monkeypatch):
    filament.filament_fault.cache_clear()
    monkeypatch.setattr(filament, "_PROBE", "import os; os.abort()")
    assert "process was terminated" in filament.filament_fault()
    filament.filament_fault.cache_clear()
