"""The Hugging Face adapter with a tiny, randomly initialised model: real files, real loading code."""

from __future__ import annotations

import json
import shutil
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from perception.detection.huggingface import HuggingFaceDetector, category_of
from perception.errors import PerceptionError
from perception.types import CameraIntrinsics, RgbdFrame

transformers = pytest.importorskip("transformers", reason="extra hf is not installed")

LABELS = {0: "person", 1: "cup", 2: "bowl"}


def save_tiny(folder: Path, labels: dict[int, str]) -> Path:
    """A MaskFormer of a few thousand weights with its image processor."""
    torch.manual_seed(0)
    backbone = transformers.SwinConfig(
        embed_dim=8, depths=[1, 1, 1, 1], num_heads=[1, 1, 1, 1], window_size=4, image_size=64,
        out_features=["stage1", "stage2", "stage3", "stage4"],
    )  # fmt: skip
    decoder = transformers.DetrConfig(
        d_model=32, encoder_layers=1, decoder_layers=1, encoder_attention_heads=2, decoder_attention_heads=2,
        encoder_ffn_dim=16, decoder_ffn_dim=16, num_queries=6, use_timm_backbone=False,
        backbone_config=transformers.ResNetConfig(embedding_size=8, hidden_sizes=[8, 8], depths=[1, 1]),
        backbone=None,
    )  # fmt: skip
    config = transformers.MaskFormerConfig(
        backbone_config=backbone, decoder_config=decoder, fpn_feature_size=32, mask_feature_size=32,
        id2label=labels, label2id={name: number for number, name in labels.items()},
    )  # fmt: skip
    transformers.MaskFormerForInstanceSegmentation(config).save_pretrained(folder)
    size = {"height": 64, "width": 64}
    transformers.MaskFormerImageProcessor(size=size, do_resize=True, size_divisor=32).save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return save_tiny(tmp_path_factory.mktemp("hf") / "tiny", LABELS)


@pytest.fixture
def frame() -> RgbdFrame:
    rgb = np.random.default_rng(0).integers(0, 255, (60, 80, 3), dtype=np.uint8)
    lens = CameraIntrinsics(80, 60, 70.0, 70.0, 39.5, 29.5)
    return RgbdFrame(0.0, rgb, np.full((60, 80), 0.6, np.float32), lens)


@pytest.mark.filterwarnings("ignore")
def test_a_saved_model_loads_and_its_masks_fit_the_image(tiny: Path, frame: RgbdFrame) -> None:
    detector = HuggingFaceDetector.load(str(tiny), min_score=0.0)
    found = detector(frame)
    assert found and all(detection.mask.shape == (60, 80) for detection in found)
    assert {detection.category for detection in found} <= {"mug", "bowl"}  # people are left out
    assert [d.score for d in found] == sorted((d.score for d in found), reverse=True)


class Answer:
    """Stands for a processor whose model is sure of two things."""

    def __call__(self, **_: Any) -> Any:
        return self

    def to(self, _: str) -> dict[str, Any]:
        return {}

    def post_process_instance_segmentation(self, outputs: Any, threshold: float, target_sizes: Any) -> Any:
        numbers = torch.full((60, 80), -1)
        numbers[10:20, 10:30], numbers[30:40, 40:60] = 1, 2
        info = [{"id": 1, "label_id": 0, "score": 0.99}, {"id": 2, "label_id": 1, "score": 0.8}]
        return [{"segmentation": numbers, "segments_info": info}]


@pytest.mark.filterwarnings("ignore")
def test_labels_are_translated_and_strangers_left_out(tiny: Path, frame: RgbdFrame) -> None:
    loaded = HuggingFaceDetector.load(str(tiny))
    detector = HuggingFaceDetector("tiny", Answer(), _Silent(loaded.model.config), "cpu")
    (found,) = detector(frame)
    assert found.category == "mug" and found.score == pytest.approx(0.8)
    assert found.mask.sum() == 10 * 20 and found.mask[35, 50]


class _Silent:
    """A model that is not asked."""

    def __init__(self, config: Any) -> None:
        self.config = config

    def __call__(self) -> None:
        return None


def test_labels_of_usual_data_sets() -> None:
    assert [category_of(name) for name in ("cup", "Coffee_cup", "bowl, soup", "Tin can", "person")] == [
        "mug", "mug", "bowl", "can", None,
    ]  # fmt: skip


@pytest.mark.filterwarnings("ignore")
def test_weights_that_cannot_be_had_are_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    with pytest.raises(PerceptionError, match="cannot be loaded") as caught:
        HuggingFaceDetector.load(str(tmp_path / "nothing"))
    assert "\n" not in str(caught.value)


@pytest.mark.filterwarnings("ignore")
def test_without_a_connection_the_hub_is_asked_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def unreachable(self: Any, name: str, timeout: float) -> None:
        asked.append(name)
        raise OSError("Name or service not known")

    monkeypatch.setattr("huggingface_hub.HfApi.model_info", unreachable)
    monkeypatch.setattr("time.sleep", lambda seconds: pytest.fail("it asks again"))
    with pytest.raises(PerceptionError, match="connection to the hub"):
        HuggingFaceDetector.load("nobody/nothing")
    assert asked == ["nobody/nothing"]


@pytest.mark.filterwarnings("ignore")
def test_code_and_pickles_of_a_model_are_not_loaded(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("builtins.input", lambda *_: "y")  # to "do you wish to run the custom code?"
    code = tmp_path / "code"
    shutil.copytree(tiny, code)
    (code / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\nclass C: pass\n")
    for name in ("config.json", "preprocessor_config.json"):
        foreign = {"model_type": "evil", "image_processor_type": "Evil"}
        classes = dict.fromkeys(("AutoConfig", "AutoImageProcessor", "AutoModel"), "evil.C")
        (code / name).write_text(json.dumps(foreign | {"auto_map": classes}))
    with pytest.raises(PerceptionError, match="cannot be loaded"):
        HuggingFaceDetector.load(str(code))
    assert not (tmp_path / "ran").exists()
    pickled = tmp_path / "pickled"
    shutil.copytree(tiny, pickled, ignore=shutil.ignore_patterns("*.safetensors"))
    torch.save({}, pickled / "pytorch_model.bin")
    with pytest.raises(PerceptionError, match="safetensors"):
        HuggingFaceDetector.load(str(pickled))


@pytest.mark.filterwarnings("ignore")
def test_a_model_without_our_classes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PerceptionError, match="no label for mugs"):
        HuggingFaceDetector.load(str(save_tiny(tmp_path / "other", {0: "person", 1: "car"})))
