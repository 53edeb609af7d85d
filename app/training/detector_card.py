"""Model card of the detector's instance and class networks."""

from __future__ import annotations

from typing import Any

import torch

from app.training.class_metrics import confusion_table
from app.training.crop_cycles import CalibratedNetwork, CropSplits
from app.training.detector_config import STACKED, TrainDetectorConfig
from perception.detection.detector import SCENE_SHARE
from perception.detection.scene_network import SceneNet
from perception.detection.tasks import LABELS


def model_card(
    config: TrainDetectorConfig,
    metrics: dict[str, Any],
    scene: SceneNet,
    trained: CalibratedNetwork,
    crops: CropSplits,
) -> str:
    """Return the model card in Markdown: architecture, training, data, evaluation and limitations."""
    second = stacked = evaluated = ""
    if crops.second is not None:
        second = _SECOND.format(second=config.second)
        stacked = _STACKED.format(config=config, crops=len(crops.second), share=STACKED)
        evaluated = f", {metrics['accuracy_with_stacks']:.3f} on as many scenes with stacks in half of them"
    return _CARD.format(
        scene_parameters=sum(p.numel() for p in scene.parameters()),
        parameters=sum(p.numel() for p in trained.network.parameters()),
        temperature=trained.temperature, crops=len(crops.training),
        second=second, stacked=stacked, evaluated=evaluated,
        class_share=1 - SCENE_SHARE, instance_share=SCENE_SHARE,
        config=config, training=config.training,
        scene_epochs=config.scene_epochs, torch=torch.__version__.split("+")[0],
        confusion=confusion_table(LABELS, metrics["confusion"], metrics["accuracy_per_class"]), m=metrics,
    )  # fmt: skip


_CARD = """# Detector: instance network and class network

**Instance network** (`scene.safetensors`): predicts for every pixel of a 320-pixel view (colour, height
above the support plane, and scale) whether it belongs to an object, of which class, and the position of its
object's footprint in the plane; instances are the clusters of these votes
(`perception/detection/instances.py`). {scene_parameters} parameters, float16.

**Class network** (`detector.safetensors`): classifies a gravity-upright crop of 64 x 64 pixels around one
instance (colour, mask, height, relative depth, and the surroundings, `perception/detection/crops.py`, with
the crop's size and elevation) as mug, bowl, bottle, can or other. {parameters} parameters, float32. Logits
are averaged over the crop and its mirror image, shifted as if all classes were equally frequent in
training, and divided by the temperature {temperature:.2f}, which was fitted on further scenes of the
training families. The detector averages the log-probabilities of class and instance networks with weights of
{class_share:.2f} and {instance_share:.2f}; masks from other sources are classified by the class network
alone.

**Training**: `nodeslam train detector --seed {training.seed}` with torch {torch}: {scene_epochs} epochs of
the instance network with batch size 8, {training.epochs} of the class network with batch size
{training.batch}, AdamW with learning rate {training.learning_rate} and cosine decay{second}. On a CPU, in
bfloat16 with float32 weights where the CPU computes with it, else in float32.

**Data**: {config.pictures} scenes with objects of the training families and distractors, rendered at 640 x
480 by MuJoCo's classic renderer (`sim_assets/datasets/training_scenes.py`): seven in ten objects in the
sizes met in homes; two in five cans and bottles with sides of free form; some objects filled, lying or
upside down (those without a class); cartons, books, tools, desk and kitchen things, random shapes and odd
vessels; tables, floors, walls and furniture around, which is neither object nor background; random
textures, prints, gloss, lights and cameras (0.3 to 1.4 m, never nearer than their sensor measures); gaps
down to contact; depth of structured light, active stereo and time of flight
(`sim_assets/rendering/depth_noise.py`), half of it with errors of calibration between colour and depth. The
images are mirrored, recoloured, and lose further depth. From these images and {config.further} more of
their kind {crops} crops for the class network: the true masks made ragged, truncated, incomplete, or extended
by a part of a neighbour; crops are mirrored, warped, shifted, truncated and recoloured.{stacked} No
photographs.

**Evaluation of the class network** on {m[crops]} such masks in {config.test} such scenes of the test
families and held-out distractors, single views: accuracy {m[accuracy]:.3f}{evaluated}; of objects alone
{m[accuracy_objects]:.3f}; distractors classified as objects {m[distractors_taken_for_objects]:.3f}, objects
classified as other {m[objects_taken_for_distractors]:.3f}; expected calibration error
{m[calibration_error]:.3f}.

{confusion}

`nodeslam evaluate detection` evaluates the whole detector.

**Limitations**: upright objects, on a plane or on and in each other. Most errors occur with strong occlusion
and with parts truncated by the image border. Clear glass and real images are not in the training data, stacks
not in those of the instance network.
"""

_SECOND = """; the class network goes on in a second
cycle of {second.epochs} epochs with learning rate {second.learning_rate}"""

_STACKED = """
The second cycle learns from {crops} crops of {config.stacked} other images, {share:.0%} of which show objects
that stand on or in others (`sim_assets/datasets/stacks.py`)."""
