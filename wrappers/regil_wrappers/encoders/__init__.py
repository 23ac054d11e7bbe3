"""Encoders: pictures in, embeddings out. The only rooms that may import torch, and lazily.

* ``Encoder`` - the protocol
* ``register_encoder``, ``make_encoder``, ``encoder_names`` - encoders by name
* ``PixelsEncoder`` - ``"pixels"``, the default: a small picture, no download
* ``TimmEncoder`` - ``"timm:<model>"``, ``"dinov2"``, ``"dinov3"``: pretrained networks
* ``embed`` - the embeddings of a demonstration's frames, cached
"""

from regil_wrappers.encoders.cache import embed
from regil_wrappers.encoders.pixels import PixelsEncoder
from regil_wrappers.encoders.protocol import Encoder, check_embedding
from regil_wrappers.encoders.registry import encoder_names, make_encoder, register_encoder
from regil_wrappers.encoders.timm_networks import TimmEncoder

__all__ = [
    "Encoder",
    "PixelsEncoder",
    "TimmEncoder",
    "check_embedding",
    "embed",
    "encoder_names",
    "make_encoder",
    "register_encoder",
]
