"""Encoders: pictures in, embeddings out. The only rooms that may import torch, and lazily.

* ``Encoder`` - the protocol
* ``register_encoder``, ``make_encoder``, ``encoder_names``, ``encoders_at_hand`` - by name
* ``PixelsEncoder`` - ``"pixels"``, the default: a small picture, no download
* ``NetworkEncoder``, ``TimmEncoder`` - a torch network, one of timm's
* ``embed`` - the embeddings of a demonstration's frames, cached
* ``fitted`` - the encoder to use beside a demonstration: whitened on it, if its name says so
* ``weights_folder`` - where files with weights are looked for
"""

from regil_wrappers.encoders.cache import embed
from regil_wrappers.encoders.network import NetworkEncoder
from regil_wrappers.encoders.pixels import PixelsEncoder
from regil_wrappers.encoders.preprocessing import Preprocessing
from regil_wrappers.encoders.protocol import Encoder, check_embedding
from regil_wrappers.encoders.registry import (
    encoder_names,
    encoders_at_hand,
    make_encoder,
    register_encoder,
    runs_code,
)
from regil_wrappers.encoders.timm_networks import TimmEncoder
from regil_wrappers.encoders.weights import weights_folder
from regil_wrappers.encoders.whitening import fitted

__all__ = [
    "Encoder",
    "NetworkEncoder",
    "PixelsEncoder",
    "Preprocessing",
    "TimmEncoder",
    "check_embedding",
    "embed",
    "encoder_names",
    "encoders_at_hand",
    "fitted",
    "make_encoder",
    "register_encoder",
    "runs_code",
    "weights_folder",
]
