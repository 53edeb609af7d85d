"""A small synthetic recording of all kinds of notes, a server, and a browser."""

import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from app.runs.replay import Recorder
from app.viewer.server import open_server
from perception.io.object_map import write_object_map
from perception.io.scan_folder import write_scan
from perception.types import CameraIntrinsics, ObjectDetection, ObjectEstimate, RgbdFrame, TriangleMesh

BODIES = ("hand", "tcp", "camera", "object0")


def upright(x, y, z=0.0, turned=False):
    T = np.eye(4)
    T[:3, 3] = x, y, z
    if turned:  # a gripper that points down
        T[:3, :3] = np.diag([1.0, -1.0, -1.0])
    return T


def can_estimate(number=0):
    mesh = trimesh.creation.cylinder(0.03, 0.1, sections=24)
    return ObjectEstimate(
        id=number,
        category="can",
        code=np.linspace(-1, 1, 16),
        T_world_object=upright(0.4, -0.2, 0.05),
        scale=np.full(3, 0.055),
        mesh=TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)),
        residual=0.0012,
        n_views=2,
    )


def frame(x):
    camera = CameraIntrinsics(64, 48, 50.0, 50.0, 31.5, 23.5)
    rgb = np.full((48, 64, 3), 120, np.uint8)
    return RgbdFrame(0.0, rgb, np.full((48, 64), 0.5, np.float32), camera, upright(x, -0.2, 0.5, turned=True))


def painted(mesh, color):
    mesh.visual = TextureVisuals(material=PBRMaterial(baseColorFactor=(*color, 255)))
    return mesh


def make_recording(seconds=2.0):
    """Return a run with two images and one can, carried from y = -0.2 m to 0.2 m."""
    meshes = {
        "world": (painted(trimesh.creation.box((1.0, 1.0, 0.02)), (120, 90, 60)),),
        "hand": (painted(trimesh.creation.box((0.06, 0.1, 0.06)), (230, 230, 230)),),
        "object0": (painted(trimesh.creation.cylinder(0.03, 0.1, sections=24), (200, 40, 40)),),
    }
    recorder = Recorder(bodies=BODIES, meshes=meshes)
    clock = iter(np.arange(0, 1000, 0.1))

    def move(y_from, y_to, with_object):
        for share in np.linspace(0, 1, max(int(10 * seconds / 4), 2)):
            y = y_from + share * (y_to - y_from)
            poses = np.zeros((len(BODIES), 7))
            poses[:3] = 0.4, y, 0.1, 0, 1, 0, 0
            poses[3] = 0.4, y if with_object else -0.2, 0.05, 1, 0, 0, 0
            recorder.sample(float(next(clock)), np.zeros(7), 0.05, poses)

    recorder.note("stage", name="scan")
    for index in range(2):
        move(-0.2, -0.2, False)
        recorder.frames.append(frame(0.35 + 0.1 * index))
        recorder.note("look", index=index)
    recorder.note("done", name="scan", seconds=3.0)
    recorder.note("stage", name="detect")
    mask = np.zeros((48, 64), bool)
    mask[20:30, 25:35] = True
    recorder.detections = tuple((ObjectDetection("can", 0.9, mask, instance_id=0),) for _ in range(2))
    for index in range(2):
        recorder.note("found", index=index, count=1)
    recorder.note("stage", name="reconstruct")
    estimate = can_estimate()
    for iteration, residual in ((0, None), (8, 0.004), (30, 0.001)):
        recorder.note(
            "fit",
            id=0,
            category="can",
            iteration=iteration,
            code=np.zeros(16),
            T_world_object=estimate.T_world_object,
            scale=estimate.scale,
            residual=residual,
        )
    recorder.objects = (estimate,)
    recorder.note("objects", covariances={"0": [1e-6] * 325})
    recorder.note("stage", name="plan")
    goal = {"name": "can_0", "T_world_stand": upright(0.4, -0.2), "position": (0.4, 0.2, 0.0), "yaws": (0.0,)}
    recorder.note("plan", placements=[goal | {"stack": ()}], left_out={})
    recorder.note("stage", name="execute")
    recorder.note("path", name="can_0", points=np.array([(0.4, -0.2, 0.1), (0.4, 0.0, 0.3), (0.4, 0.2, 0.1)]))
    T_stand_tcp = upright(0, 0, 0.1, turned=True)
    for phase in ("approach", "grasp", "transfer", "place", "retreat", "placed"):
        details = {}
        if phase == "approach":
            details = {"T_stand_tcp": T_stand_tcp, "T_world_stand_rest": upright(0.4, 0.2)}
            details["grasps"] = [T_stand_tcp, upright(0, 0, 0.08, turned=True)]
        recorder.note("action", phase=phase, name="can_0", message="", done=0, total=1, **details)
        if phase == "transfer":
            move(-0.2, 0.2, True)
        else:
            y = 0.2 if phase in ("place", "retreat", "placed") else -0.2
            move(y, y, y > 0)
    recorder.note("done", name="execute", seconds=5.0)
    return recorder


@pytest.fixture
def until():
    """Wait until a condition holds."""

    def until_(condition, seconds=60):
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, "the condition did not become true in time"
            time.sleep(0.02)

    return until_


@pytest.fixture
def recording():
    return make_recording()


@pytest.fixture
def make_can():
    """Return a function that makes an estimate of a can at (0.4, -0.2) m with a given id."""
    return can_estimate


@pytest.fixture
def make_frame():
    """Return a function that makes an image of a camera above the table at a given x [m]."""
    return frame


@pytest.fixture(scope="session")
def shared_server():
    server = open_server(port=0)
    yield server
    server.stop()


@pytest.fixture
def server(shared_server):
    """A server with an empty scene and panel."""
    shared_server.scene.reset()
    shared_server.gui.reset()
    return shared_server


@pytest.fixture
def node(server):
    """Return a function that finds a node of the scene by name; None if there is none."""
    return lambda name: server.scene._handle_from_node_name.get(name)


@pytest.fixture
def run_folder(tmp_path, recording):
    """The recording in a run folder of `pack`."""
    folder = tmp_path / "run"
    recording.write(folder)
    recording.write_meshes(folder)
    write_scan(folder / "scan", recording.frames, recording.detections)
    write_object_map(folder, [replace(recording.objects[0], covariance=None)])
    (folder / "report.json").write_text('{"command": "pack", "seed": 3, "reason": "1 of 1", "objects": []}')
    return folder


@pytest.fixture(scope="session")
def chromium():
    """Debian's Chromium under playwright; skips if it is not installed."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed (extra: dev)")
    names = ("chromium", "chromium-browser", "google-chrome")
    path = next(filter(None, (shutil.which(name) for name in names)), None)
    if path is None:
        pytest.skip("no Chromium on this machine: apt-get install chromium")
    with playwright.sync_playwright() as driver:
        # Software rendering by Mesa, as in the simulator's headless renderer.
        flags = ["--no-sandbox", "--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist"]
        browser = driver.chromium.launch(executable_path=path, args=flags)
        yield browser
        browser.close()


class Page:
    """A page of a browser that collects its errors."""

    def __init__(self, browser, url, size=(800, 500)):
        self.page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        self.page.set_default_timeout(90_000)  # rendering without a GPU is slow
        self.problems = []
        self.page.on("console", lambda line: line.type == "error" and self.problems.append(line.text))
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.on("requestfailed", lambda request: self.problems.append(request.url))
        self.page.goto(url if "://" in url else Path(url).as_uri())


@pytest.fixture
def open_page(chromium):
    pages = []

    def open_(url, **options):
        pages.append(Page(chromium, url, **options))
        return pages[-1]

    yield open_
    for page in pages:
        page.page.close()
