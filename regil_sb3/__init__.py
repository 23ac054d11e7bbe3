"""ReGIL on Stable-Baselines3: TD3 with a decaying behaviour-cloning term, warmed up by a guide.

Importing this package registers its environments (Gymnasium 1.x reads no plugin entry points).
The rest is loaded on first use, so that environments alone do not pay for torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import regil_sb3.envs  # noqa: F401  registers regil/...

if TYPE_CHECKING:
    from regil_sb3.guided import GuidedWarmup as GuidedWarmup
    from regil_sb3.success_buffer import SuccessBuffer as SuccessBuffer
    from regil_sb3.td3bc import TD3BC as TD3BC
    from regil_sb3.vec_env import VecRetrievalGuide as VecRetrievalGuide
    from regil_sb3.vec_env import VecRetrievalReward as VecRetrievalReward

__version__ = "0.1.0"
__all__ = [
    "TD3BC",
    "GuidedWarmup",
    "SuccessBuffer",
    "VecRetrievalGuide",
    "VecRetrievalReward",
]

_HOME = {
    "TD3BC": "regil_sb3.td3bc",
    "GuidedWarmup": "regil_sb3.guided",
    "SuccessBuffer": "regil_sb3.success_buffer",
    "VecRetrievalGuide": "regil_sb3.vec_env",
    "VecRetrievalReward": "regil_sb3.vec_env",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'regil_sb3' has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)
