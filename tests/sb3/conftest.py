"""One thread for torch: the tests' networks are small, and CI shares its cores."""

import torch

torch.set_num_threads(1)
