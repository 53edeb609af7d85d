"""The card of a data set."""

from app.collect.card import card, command_of
from app.options import CollectOptions


def test_the_card_states_success_and_the_command(config):
    lines = [{"success": True, "n_frames": 3}, {"success": False, "n_frames": 4}]
    options = CollectOptions(episodes=2, objects="can=1", filter="success")
    text = card(options, config, lines, lines[:1])
    assert text.startswith("---\nlicense: ") and "| episodes | 1, 1 of them successful |" in text
    assert "| success of all 2 that were run | 50% (95 % interval 9% to 91%, Wilson) |" in text
    assert (
        "left out" in text
        and "nodeslam collect --task pack --episodes 2 --objects can=1 --filter success" in text
    )


def test_the_command_names_what_differs_from_the_defaults():
    options = CollectOptions(task="sort", episodes=5, seed=3, no_images=True)
    assert command_of(options) == "nodeslam collect --task sort --episodes 5 --seed 3 --no-images"


def test_the_command_names_the_scene_but_not_the_workers():
    scene = {"gap": 0.02, "lying": 1, "clutter": True, "friction": "0.3,0.9", "scan_views": 3}
    options = CollectOptions(**scene, workers=8, ray="auto", resume=True, quiet=True)
    words = "--friction 0.3,0.9 --gap 0.02 --lying 1 --scan-views 3 --clutter"
    command = command_of(options)
    assert all(f"--{word.strip()}" in command for word in words.split("--") if word)
    assert not any(word in command for word in ("workers", "ray", "resume", "quiet"))
