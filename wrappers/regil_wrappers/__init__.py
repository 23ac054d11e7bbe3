"""A dense reward and a guide from one demonstration, as Gymnasium wrappers (the retrieval of ReGIL)."""

from regil_wrappers.demonstration import Demonstration
from regil_wrappers.encoders import Encoder, encoder_names, make_encoder, register_encoder
from regil_wrappers.retrieval import Alignment, Retriever
from regil_wrappers.wrappers import RetrievalGuideWrapper, RetrievalRewardWrapper

__all__ = [
    "Alignment",
    "Demonstration",
    "Encoder",
    "Retriever",
    "RetrievalGuideWrapper",
    "RetrievalRewardWrapper",
    "encoder_names",
    "make_encoder",
    "register_encoder",
]
__version__ = "0.1.0"
