"""A dense reward and a guide from one demonstration, as Gymnasium wrappers."""

from regil_wrappers import formats
from regil_wrappers.demonstration import Demonstration
from regil_wrappers.encoders import Encoder, encoder_names, make_encoder, register_encoder
from regil_wrappers.retrieval import Alignment, Retriever
from regil_wrappers.wrappers import RetrievalGuideWrapper, RetrievalRewardWrapper

__all__ = [
    "Alignment",
    "Demonstration",
    "Encoder",
    "RetrievalGuideWrapper",
    "RetrievalRewardWrapper",
    "Retriever",
    "encoder_names",
    "formats",
    "make_encoder",
    "register_encoder",
]
__version__ = "0.1.0"
