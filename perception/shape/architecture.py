"""Sizes of the shape prior's layers, for the networks that are trained and for the decoder of inference."""

from __future__ import annotations

from perception.types import CATEGORIES, CODE_SIZE

CHANNELS = (16, 32, 64, 128, 256)  # after each halving of the resolution: 16^3, 8^3, 4^3, 2^3, 1^3
_C1, _C2, _C3, _C4, _C5 = CHANNELS

# Parameters of the decoder by their names in ``network.DecoderNetwork``.
DECODER_SHAPES: dict[str, tuple[int, ...]] = {
    "linear0.weight": (_C5, CODE_SIZE + len(CATEGORIES)),
    "linear0.bias": (_C5,),
    "linear1.weight": (8 * _C4, _C5),
    "linear1.bias": (8 * _C4,),
    "up2.weight": (_C4, _C3, 4, 4, 4),
    "up2.bias": (_C3,),
    "up3.weight": (_C3, _C2, 4, 4, 4),
    "up3.bias": (_C2,),
    "up4.weight": (_C2, _C1, 4, 4, 4),
    "up4.bias": (_C1,),
    "out_weight": (_C1, 1, 4, 4, 4),
    "out_bias": (1,),
}
