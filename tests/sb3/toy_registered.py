"""`toy_registered:Toy/Reach-v0`: the toy environment as other processes find it."""

import gymnasium as gym
from toy import Reach


class Drawn(Reach):
    """The toy, as `gymnasium.make` and SB3 make environments."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, render_mode=None, **kwargs):
        super().__init__(**kwargs)
        self.render_mode = render_mode


gym.register("Toy/Reach-v0", entry_point=Drawn)
