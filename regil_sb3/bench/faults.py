"""`regil bench faults`: nothing lost, and nothing run that should not be, counted.

* kills - SIGKILLs at random moments of a small run that is resumed each time: its end is the same
* disk - a fault at every write, fsync and rename of a save: a checkpoint loads each time
* files, checkpoints, pickles, yaml, archives - damaged and hostile files, read in processes that
  may grow by 512 MiB: each is read whole or refused in one line, and nothing in it is executed
* numbers - NaN and infinity at random places of a learner: it ends, and says so
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

from regil_wrappers.formats import fuzz
from tqdm import tqdm

from regil_sb3.bench import disk_faults, hostile, lives
from regil_sb3.bench.machine import commit
from regil_sb3.files import replacing

__all__ = ["COUNTS", "Tally", "main"]

COUNTS = {
    "kills": 200,
    "disk": len(disk_faults.HOW),
    "files": 50_000,
    "checkpoints": 5_000,
    "pickles": 72,
    "yaml": 200,
    "archives": 50,
    "numbers": 1_000,
}
"""How many of each part, where it is not said."""
_CHUNK = {"files": 500, "checkpoints": 500}
_SHOWN = 5  # of what went wrong in a part


@dataclass
class Tally:
    """What became of a part's cases so far.

    Attributes:
        done: kills, kinds of fault, files or learners.
        next: number of the next case.
        read: files that were read, faults at a call.
        refused: files refused, saves that said that they had failed.
        wrong: a line for each case that did not go as it must.
        commits: of the code that did them.
    """

    done: int
    next: int
    read: int
    refused: int
    wrong: list[str]
    commits: list[str] = field(default_factory=list)


def main(out: str = "faults", **counts: int) -> dict[str, Tally]:
    """Do the parts, or go on with them, and print a table.

    Args:
        out: folder where what is done is kept; what it holds is not done again.
        **counts: of parts; those that are not named are left out, if any is.

    Returns:
        what became of each part.

    Raises:
        ValueError: a count is out of range; or, after the table, what went wrong in some case.
    """
    for part, count in counts.items():
        if count < 1 or (part == "disk" and count > len(disk_faults.HOW)):
            raise ValueError(f"--{part} {count}: 1 to {COUNTS['disk']} for disk, else at least 1")
    folder, here = Path(out), commit()
    folder.mkdir(parents=True, exist_ok=True)
    tallies = {}
    for part, count in (counts or COUNTS).items():
        kept = folder / f"{part}.json"
        tally = Tally(0, 0, 0, 0, [])
        if kept.exists():
            tally = Tally(**json.loads(kept.read_text("utf-8")))
        with tqdm(total=count, desc=part, dynamic_ncols=True, initial=tally.done) as bar:
            for _ in _part(part, tally, count):
                tally.commits = list(dict.fromkeys([*tally.commits, here]))
                with replacing(kept) as file:
                    file.write(json.dumps(asdict(tally), indent=1).encode())
                bar.update(tally.done - bar.n)
        tallies[part] = tally
    print("| part | done | read | refused | wrong |\n|---|---|---|---|---|")
    for part, tally in tallies.items():
        print(f"| {part} | {tally.done} | {tally.read} | {tally.refused} | {len(tally.wrong)} |")
    done_at = {name for tally in tallies.values() for name in tally.commits or ["not known"]}
    print(f"\nDone at commit {', '.join(sorted(done_at))}, now {here}. To begin anew: remove {out}")
    wrong = [f"{part}: {line}" for part, tally in tallies.items() for line in tally.wrong[:_SHOWN]]
    if wrong:
        raise ValueError(f"{len(wrong)} went wrong: {'; '.join(wrong)}")
    return tallies


def _part(part: str, tally: Tally, count: int) -> Iterator[None]:
    """Do the rest of a part; after each yield, what is done may be kept."""
    if tally.done >= count:
        return
    if part == "kills":
        with tempfile.TemporaryDirectory() as folder:
            expected, seconds = lives.reference(Path(folder))
        while tally.done < count:
            kills, error = lives.chain(tally.next, expected, seconds)
            tally.done, tally.next, tally.read = tally.done + kills, tally.next + 1, tally.next + 1
            tally.wrong += [f"chain {tally.next}: {error}"] if error else []
            yield
        return
    while tally.done < count:
        first, some = tally.done, min(_CHUNK.get(part, 50), count - tally.done)
        if part == "disk":
            some = 1
            with tempfile.TemporaryDirectory() as folder:
                calls, failed, wrong = disk_faults.at_every_call(
                    disk_faults.HOW[first], Path(folder)
                )
            found = {"read": calls, "refused": failed}
        elif part == "numbers":
            some = 1
            error = lives.spoilt(first)
            wrong = [f"case {first}: {error}"] if error else []
            found = {"read": 0, "refused": int(not error)}
        elif part == "files":
            found, wrong = fuzz.run(some, first)
        else:
            found, wrong = fuzz.run(some, first, hostile.__name__, part)
        tally.done = tally.next = first + some
        tally.read, tally.refused = tally.read + found["read"], tally.refused + found["refused"]
        tally.wrong += wrong
        yield
