"""A callback for tests of what happens in the middle of `learn`."""

from stable_baselines3.common.callbacks import BaseCallback


class At(BaseCallback):
    """Does something at a step."""

    def __init__(self, step, what):
        super().__init__()
        self.step, self.what = step, what

    def _on_step(self):
        if self.num_timesteps == self.step:
            self.what()
        return True
