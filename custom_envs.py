"""Imported by rl_zoo3's own commands when they run here: registers the environments regil/..."""

import regil_sb3  # noqa: F401
