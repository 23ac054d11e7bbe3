"""How often the 95 % interval of `regil_sb3.intervals.iqm` holds the truth, with few runs.

python docs/interval_coverage.py    about two minutes

Runs' successes are drawn from a beta distribution with mean .6 and a standard deviation of .2 on
every task, as methods in docs/results.md that neither fail nor succeed always; the truth is the
interquartile mean of very many runs.
"""

import numpy as np
from scipy.stats import trim_mean

from regil_sb3.intervals import iqm

TRIALS = 1_000
MEAN, DEVIATION = 0.6, 0.2


def main():
    """Print a line for each number of tasks and runs."""
    rng = np.random.default_rng(0)
    both = MEAN * (1 - MEAN) / DEVIATION**2 - 1

    def draw(*shape):
        return rng.beta(MEAN * both, (1 - MEAN) * both, shape)

    truth = trim_mean(draw(1_000_000), 0.25)
    print("| tasks | runs a task | holds it |\n|---|---|---|")
    for tasks, runs in ((1, 2), (2, 2), (1, 5), (2, 5), (7, 5), (1, 10), (2, 10)):
        found = [iqm(draw(tasks, runs)) for _ in range(TRIALS)]
        held = np.mean([one.low <= truth <= one.high for one in found])
        print(f"| {tasks} | {runs} | {100 * held:.0f} % |", flush=True)


if __name__ == "__main__":
    main()
