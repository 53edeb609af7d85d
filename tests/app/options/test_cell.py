"""Options of the viewer, of replays and of the robot in another process, where there is none."""

from pathlib import Path

import pytest

from app.options import CommonOptions, PackOptions, ViewOptions

RUN = Path("run")


@pytest.mark.parametrize(
    ("options", "ignored"),
    [
        (PackOptions(port=8090), {"port": "without --view"}),
        (PackOptions(host="0.0.0.0", view=True), {}),
        (PackOptions(hand_eye=Path("eye.toml")), {"hand_eye": "without --connect"}),
        (PackOptions(hand_eye=Path("eye.toml"), connect="ipc://robot"), {}),
        (ViewOptions(run=RUN, unknown=2), {"unknown": "on the replay of a run"}),
        (ViewOptions(run=RUN, task="sort"), {"task": "on the replay of a run"}),
        (ViewOptions(run=RUN, port=8090, seed=3), {}),
        (ViewOptions(run=RUN, html=Path("page.html"), port=8090), {"port": "with --html"}),
        (ViewOptions(task="sort", objects="3", shapes="tsdf"), {}),
    ],
)
def test_options_without_effect(options: CommonOptions, ignored: dict[str, str]):
    reasons = options.without_effect().items()
    assert {name: why for why, names in reasons for name in options.changed().intersection(names)} == ignored
