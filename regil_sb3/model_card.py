"""What a run folder says of itself to others.

- ``write_card``: ``README.md``, a model card as the Hugging Face hub reads it.
- ``push``: the run folder to the hub, when its owner says so.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from regil_sb3.baselines import Offline
from regil_sb3.evaluation import METHODS
from regil_sb3.files import replacing
from regil_sb3.settings import ALGOS, OURS, Settings

__all__ = ["SHARED", "push", "write_card"]

SHARED = (
    *("README.md", "config.yaml", "model.zip", "best_model.zip", "bc_model.zip"),
    *("demo.hdf5", "calibration.json", "evaluation.json", "episode.hdf5", "report.html"),
    *("progress.csv", "events.out.tfevents.*"),
)
"""The files of a run folder that ``push`` uploads."""

_CARD = """\
---
{front}---

# {algorithm} on `{env}`

A policy that was learned from one demonstration: {how}, in {steps:,} {unit} ({frames:,} frames).

| {episodes} unseen episodes, seeds from {first_seed} on | success |
|---|---|
{table}

Preset `{preset}`, seed {seed}; every setting and the versions it was made with are in
`config.yaml`, the curves in `report.html`. Success was counted in this environment only, and
nothing here limits what the policy does to a robot.

## Use it

```python
from pathlib import Path

from huggingface_hub import snapshot_download
from regil_sb3{home} import {algorithm}
from regil_sb3.settings import Settings
from regil_sb3.training import make_env

run = Path(snapshot_download("{repo}"))
env = make_env(Settings.load(run / "config.yaml"), run / "demo.hdf5", n_envs=1)
model = {algorithm}.load(run / "model.zip", buffer_size=1)
action, _ = model.predict(env.reset(), deterministic=True)
```

Or evaluate it again: `hf download {repo} --local-dir RUN`, then `regil evaluate RUN`.
"""

_HOW = {
    **dict.fromkeys(OURS, "ReGIL's guided warm-up, behaviour cloning on what succeeded, and TD3"),
    "bc": "behaviour cloning",
    "baku": "cloning of chunks of its actions",
    "rot": "behaviour cloning, and RL on transport rewards",
}

_HOMES = {"td3bc": "", "td3bc-background": ".background"}


def write_card(run: Path, repo: str = "OWNER/NAME") -> Path:
    """Write a run folder's model card from its settings and its evaluation.

    Args:
        run: the folder; it has been evaluated.
        repo: where on the hub it says that the model lies.

    Returns:
        The path of the card.

    Raises:
        ValueError: no run folder, or one without an evaluation.
    """
    settings = Settings.load(run / "config.yaml", trust=True)  # nothing of it is run
    try:
        results: dict[str, Any] = json.loads((run / "evaluation.json").read_text("utf-8"))
        missing = {"policy", "steps", "frames", "seeds"} - set(results)
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"{run} has no evaluation ({error}): regil evaluate {run}") from error
    if missing:
        raise ValueError(f"{run}'s policy is not evaluated: regil evaluate {run}")
    algorithm = ALGOS[settings.algo]
    guided = settings.warmup_steps > 0 or settings.hyperparams.get("bc_coef") != 0
    found = {name: results[name] for name in METHODS if name in results}
    episodes = results["policy"]["episodes"]
    task = {"type": "reinforcement-learning", "name": "reinforcement-learning"}
    metrics = [
        {
            "type": "success_rate",
            "value": found[name]["success"],
            "name": f"success of {file} in {episodes} unseen episodes",
            "verified": False,
        }
        for name, file in (("policy", "model.zip"), ("best_policy", "best_model.zip"))
        if name in found
    ]
    front = {
        "library_name": "stable-baselines3",
        "pipeline_tag": "reinforcement-learning",
        "tags": [
            *("reinforcement-learning", "deep-reinforcement-learning", "imitation-learning"),
            *("robotics", "stable-baselines3", "regil", settings.algo, settings.env),
        ],
        "model-index": [
            {
                "name": algorithm.__name__,
                "results": [
                    {
                        "task": task,
                        "dataset": {"name": settings.env, "type": settings.env},
                        "metrics": metrics,
                    }
                ],
            }
        ],
    }
    card = _CARD.format(
        algorithm=algorithm.__name__,
        home=_HOMES.get(settings.algo, ".baselines"),
        how=_HOW[settings.algo] if guided else "TD3 on a reward that compares pictures with it",
        unit="updates" if issubclass(algorithm, Offline) else "agent steps",
        front=yaml.safe_dump(front, sort_keys=False),
        env=settings.env,
        steps=results["steps"],
        frames=results["frames"],
        episodes=episodes,
        first_seed=f"{results['seeds'][0]:,}",
        table="\n".join(f"| {METHODS[n]} | {r['success']:.2f} |" for n, r in found.items()),
        preset=settings.preset,
        seed=settings.seed,
        repo=repo,
    )
    with replacing(run / "README.md") as file:
        file.write(card.encode())
    return run / "README.md"


def push(
    run: Path,
    repo: str,
    private: bool = False,
    progress: Callable[[Path], None] | None = None,
) -> str:
    """Upload a run folder to the Hugging Face hub, with a card that names the repository.

    Args:
        run: the folder; it has been evaluated.
        repo: "OWNER/NAME"; made where it does not exist.
        private: make it private, and refuse one that is public.
        progress: called with each file before any is uploaded.

    Returns:
        The repository's address.

    Raises:
        ValueError: `huggingface_hub` is missing, nobody is logged in, the folder is no evaluated
            run, or the hub refuses.
    """
    try:
        from huggingface_hub import HfApi, get_token
        from huggingface_hub.errors import HfHubHTTPError
    except ImportError as error:
        raise ValueError(
            f"`regil push` needs huggingface_hub ({error}): pip install 'regil-sb3[hub]'"
        ) from error
    if get_token() is None:
        raise ValueError("not logged in to the Hugging Face hub: `hf auth login`, or set HF_TOKEN")
    write_card(run, repo)
    if progress is not None:
        for path in (path for pattern in SHARED for path in sorted(run.glob(pattern))):
            progress(path)
    api = HfApi()
    try:
        address = api.create_repo(repo, private=private or None, exist_ok=True)
        if private and not api.model_info(repo).private:
            raise ValueError(f"{repo} exists and is public: make it private first, or name another")
        api.upload_folder(
            repo_id=repo,
            folder_path=run,
            allow_patterns=list(SHARED),
            commit_message="regil push",
        )
    except Exception as error:
        # What the hub says, and connections that fail: of the library that it uses for HTTP
        if not isinstance(error, HfHubHTTPError.__bases__):
            raise
        said = " ".join(str(error).split())
        raise ValueError(f"the hub did not take {run} as {repo}: {said}") from error
    return str(address)
