"""The command: episodes by seed, failures, resume, filter, bad input."""

import json

import pytest

from app.cli import run as run_cli
from app.collect import command
from app.collect.recording import record
from app.errors import UsageError
from app.options import CollectOptions
from app.screen import Screen


@pytest.fixture
def fake(monkeypatch, short):
    """Record short episodes; seed 1 fails, seed 2 crashes."""
    ran = []

    def collect(options, seed):
        ran.append(seed)
        if seed == 2:
            raise ZeroDivisionError("of all things")
        episode = record(*short(length=9 if seed == 1 else 3, patience=4), seed=seed)
        line = command.failed_seed(options, seed, command.Failure("", 0.1))
        line |= {"success": episode.success, "reason": "done", "n_frames": episode.n_frames}
        return line | {"stats": episode.stats, "files": episode.files}

    monkeypatch.setattr(command, "collect_seed", collect)
    return ran


def collected(out, **options):
    return command.run(CollectOptions(out=out, quiet=True, **options), Screen(quiet=True))


def info(out):
    return json.loads((out / "meta/info.json").read_text())


def test_failures_are_kept_and_marked(tmp_path, fake):
    report = collected(tmp_path / "set", episodes=3, seed=0)
    assert not report.success and report.reason == (
        "3 of 3 episodes, 1 successful, 2 in the set, 1 not run to their end"
    )
    assert info(tmp_path / "set")["total_episodes"] == 2
    assert "LeRobot" in (tmp_path / "set/README.md").read_text()


def test_the_filter_leaves_failures_out(tmp_path, fake):
    assert collected(tmp_path / "set", episodes=2, filter="success").success
    assert info(tmp_path / "set")["total_frames"] == 3


def test_an_interrupted_collection_is_resumed(tmp_path, fake, monkeypatch):
    out = tmp_path / "set"
    whole = command.assemble
    monkeypatch.setattr(command, "assemble", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        collected(out, episodes=2)
    monkeypatch.setattr(command, "assemble", whole)
    assert collected(out, episodes=4, resume=True, filter="success").metrics["n_episodes"] == 4
    assert fake == [0, 1, 2, 3] and info(out)["total_episodes"] == 2
    with pytest.raises(UsageError, match="is complete"):
        collected(out, episodes=4, resume=True)


@pytest.mark.parametrize("step", ["_write_card", "remove_parts"])
def test_a_collection_interrupted_after_its_last_episode_is_completed(tmp_path, fake, monkeypatch, step):
    out, whole = tmp_path / "set", getattr(command, step)
    monkeypatch.setattr(command, step, lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        collected(out, episodes=2)
    monkeypatch.setattr(command, step, whole)
    assert collected(out, episodes=2, resume=True).metrics["n_kept"] == 2
    assert fake == [0, 1] and not list((out / "episodes").glob("*/*"))
    assert "LeRobot" in (out / "README.md").read_text()


def test_a_persons_file_is_not_replaced_by_the_card(tmp_path, fake, monkeypatch):
    whole = command.assemble

    def assemble(folder, *rest):
        (folder / "README.md").write_text("mine")
        whole(folder, *rest)

    monkeypatch.setattr(command, "assemble", assemble)
    assert collected(tmp_path / "set", episodes=1).success
    assert (tmp_path / "set/README.md").read_text() == "mine"


@pytest.mark.parametrize("size", ["0,0", "224", "33,32", "a,b", "32,1000", "-32,32"])
def test_sizes_that_cannot_be_encoded(tmp_path, size, capsys):
    assert run_cli(["collect", f"--image-size={size}", "--out", str(tmp_path / "set")]) == 2
    assert "--image-size" in capsys.readouterr().err
    assert not (tmp_path / "set").exists()


def test_names_fit_the_robot():
    config = command.config_of(CollectOptions(control="tcp", no_images=True))
    assert len(config.state_names) == 15 and len(config.action_names) == 7 and config.cameras == ()


def test_failed_seeds_have_no_frames():
    line = command.failed_seed(CollectOptions(), 4, command.Failure("crashed", 1.0))
    assert (line["seed"], line["n_frames"], line["success"], line["reason"]) == (4, 0, False, "crashed")


def test_a_resumed_collection_needs_the_same_scene(tmp_path, fake):
    collected(tmp_path / "set", episodes=2, filter="success", gap=0.02)
    report = json.loads((tmp_path / "set/report.json").read_text())
    assert report["settings"]["gap"] == "0.02" and report["settings"]["filter"] == "success"
    assert "workers" not in report["settings"] and report["settings"]["scan_views"] == "6"
    (tmp_path / "set/meta/info.json").unlink()
    with pytest.raises(UsageError, match="gap"):
        collected(tmp_path / "set", episodes=3, resume=True, gap=0.03)


def test_faults_are_refused(tmp_path):
    with pytest.raises(UsageError, match="--fault is an option of pack, sort and evaluate tasks"):
        collected(tmp_path / "set", episodes=1, fault="any")


@pytest.mark.parametrize("damage", ["line", "missing", "truncated"])
def test_damaged_episodes_are_repeated(tmp_path, fake, monkeypatch, damage):
    out, whole = tmp_path / "set", command.assemble
    monkeypatch.setattr(command, "assemble", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        collected(out, episodes=2)
    monkeypatch.setattr(command, "assemble", whole)
    frames = out / "episodes/0/frames.parquet"
    if damage == "line":
        first, *others = (out / "episodes.jsonl").read_text().splitlines()
        line = {key: value for key, value in json.loads(first).items() if key != "n_frames"}
        (out / "episodes.jsonl").write_text("\n".join([json.dumps(line), *others]) + "\n")
    elif damage == "missing":
        frames.unlink()
    else:
        frames.write_bytes(frames.read_bytes()[:-20])
    assert collected(out, episodes=2, resume=True).metrics["n_kept"] == 2
    assert fake == [0, 1, 0] and info(out)["total_episodes"] == 2
