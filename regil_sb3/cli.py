"""The command line, `regil`.

``regil record | convert | doctor | train | evaluate | report | push | bench``.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path
from typing import Any


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="regil", description="Learn a manipulation skill from one demonstration."
    )
    commands = parser.add_subparsers(dest="command", required=True)

    record = commands.add_parser(
        "record", help="record the scripted expert of an environment, or a person"
    )
    record.add_argument("env", help="id of the environment, e.g. regil/metaworld-button-press-v0")
    record.add_argument("-o", "--out", type=Path, help="file (demos/<id after the slash>.hdf5)")
    record.add_argument("--seed", type=int, default=0, help="first seed to try (0)")
    record.add_argument(
        "--size",
        type=int,
        help="height and width of the frames (the environment's own: 84, LIBERO 128)",
    )
    record.add_argument(
        "--encoder-size", type=int, help="keep larger frames of this size for the encoder too"
    )
    record.add_argument(
        "--env-kwargs", nargs="*", default=[], metavar="KEY=VALUE", help="e.g. size=128"
    )
    record.add_argument(
        "--teleop",
        choices=["keyboard", "gamepad", "spacemouse"],
        help="steer by hand in a window (keyboard, where there is no scripted expert)",
    )
    record.add_argument(
        "--live", action="store_true", help="by hand: time passes while nothing is pressed, too"
    )

    convert = commands.add_parser("convert", help="a demonstration from one format to another")
    convert.add_argument("source", type=Path, metavar="IN", help="file or folder")
    convert.add_argument("target", type=Path, metavar="OUT", help="new file or folder")
    convert.add_argument("--from", dest="source_format", metavar="FORMAT", help="of IN (looked up)")
    convert.add_argument("--format", help="of OUT (by its suffix)")
    convert.add_argument("--episode", type=int, help="which, of several (0)")
    convert.add_argument("--camera", help="key of the pictures")
    convert.add_argument("--observations", nargs="*", metavar="KEY", help="others to keep (all)")
    convert.add_argument(
        "--flip",
        choices=["rows", "columns", "both"],
        help="put pictures right that are stored turned",
    )
    convert.add_argument(
        "--crop", type=int, nargs=4, metavar=("TOP", "LEFT", "HEIGHT", "WIDTH"), help="pixels"
    )
    for flag, what in (
        ("--size", "height and width, or one number"),
        ("--encoder-size", "the same, of a second, larger copy for the encoder"),
    ):
        convert.add_argument(flag, type=int, nargs="+", metavar="PIXELS", help=what)
    convert.add_argument("--source-fps", type=float, help="frames a second of IN, if it says none")
    convert.add_argument("--fps", type=float, help="resample to so many frames a second")
    convert.add_argument(
        "--actions",
        choices=["refuse", "drop", "sum", "mean", "last"],
        default="refuse",
        help="what --fps makes of actions: sum or mean of deltas, last of targets (refuse)",
    )
    convert.add_argument(
        "--held", type=int, nargs="+", default=[], metavar="DIM", help="that take the last: gripper"
    )

    doctor = commands.add_parser(
        "doctor",
        help="say whether a demonstration can work in an environment",
        epilog="exit status: 0 nothing is wrong (there may be warnings), 1 something is, "
        "2 it could not be examined",
    )
    doctor.add_argument("env", help="id of the environment")
    doctor.add_argument("demo", type=Path, help="demonstration")
    doctor.add_argument(
        "--episodes", type=int, default=5, help="guided episodes, plain and corrected each (5)"
    )
    doctor.add_argument("--image", help="where pictures come from: obs, obs:KEY or render (obs)")
    doctor.add_argument("--preset", help="a section of zoo_configs/td3bc.yml or baselines.yml")
    doctor.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="as for train"
    )
    doctor.add_argument(
        "--search",
        nargs="*",
        metavar="ENCODER",
        help="try encoders (those that need no download), k and horizon, and recommend",
    )
    doctor.add_argument("--html", type=Path, metavar="FILE", help="write a page, too")

    train = commands.add_parser("train", help="learn, evaluate, and write a report")
    train.add_argument("--env", help="id of the environment")
    train.add_argument(
        "--algo",
        choices=["td3bc", "td3bc-background", "bc", "rot", "baku"],
        help="(td3bc); -background: updates beside control, for robots; others: with their preset",
    )
    train.add_argument("--demo", type=Path, help="demonstration; recorded when it is not there")
    train.add_argument("--seed", type=int, help="of all random generators (0)")
    train.add_argument("--out", type=Path, help="run folder (runs/<id after the slash>-<seed>)")
    train.add_argument("--preset", help="a section of zoo_configs/td3bc.yml or baselines.yml")
    train.add_argument("--steps", type=int, help="agent steps")
    train.add_argument("--episodes", type=int, default=20, help="unseen episodes at the end (20)")
    train.add_argument("--resume", type=Path, metavar="RUN", help="go on with an interrupted run")
    train.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="any argument of the algorithm or of the retrieval wrappers; env_kwargs.NAME, "
        "policy_kwargs.NAME; n_envs, frame_stack, policy, eval_episodes, eval_freq",
    )

    evaluate = commands.add_parser(
        "evaluate", help="evaluate policy, best policy, both guides and BC"
    )
    evaluate.add_argument("run", type=Path)
    evaluate.add_argument("--episodes", type=int, default=40, help="unseen episodes of each (40)")
    evaluate.add_argument(
        "--trust",
        action="store_true",
        help="config and models may name anything, and so run code: your own policies and encoders",
    )

    report = commands.add_parser(
        "report", help="make the HTML page of a run, or one that compares several"
    )
    report.add_argument("run", type=Path, nargs="+", metavar="RUN")
    report.add_argument(
        "-o",
        "--out",
        type=Path,
        help="file (RUN/report.html; of several, comparison.html beside the first)",
    )

    push = commands.add_parser("push", help="upload a run folder to the Hugging Face hub")
    push.add_argument("run", type=Path)
    push.add_argument("repo", metavar="REPO", help="OWNER/NAME on the hub")
    push.add_argument("--private", action="store_true", help="for you alone")

    bench = commands.add_parser("bench", help="measure, as ratios in one run")
    bench.add_argument(
        "table",
        help="rendering, retrieval, ranking, guide, success-buffer, sensitivity, latency, "
        "real-time, memory, index, throughput, faults; "
        "baselines, ablations, rewards, tuning (training runs); "
        "buffer-vs-learning, trajectories (of runs that have ended); results (a page of all that "
        "is kept)",
    )
    bench.add_argument(
        "--tasks",
        nargs="+",
        metavar="TASK",
        help="Meta-World's, or ids of environments (the paper's 7; training runs: those of "
        "zoo_configs/tables.yml); real-time: reach, insert, open (reach)",
    )
    bench.add_argument(
        "--seeds", nargs="+", type=int, help="of demonstrations and runs (0 1, or 0)"
    )
    bench.add_argument(
        "--episodes",
        type=int,
        help="goals: of each (20; 40); sensitivity: of a cell, all tasks together (50); "
        "trajectories: of the policy (10)",
    )
    bench.add_argument(
        "--each-task",
        action="store_true",
        default=None,
        help="sensitivity: so many --episodes of each task",
    )
    bench.add_argument("--disturbances", nargs="+", metavar="NAME", help="guide: (none)")
    bench.add_argument("--steps", type=int, help="agent steps (5000; 15000; 3000)")
    bench.add_argument(
        "--encoders",
        nargs="+",
        metavar="NAME",
        help="latency: (pixels, efficientnet-lite0); sensitivity: (the paper's, and two more)",
    )
    bench.add_argument(
        "--frames", nargs="+", type=int, help="latency, memory, index: sizes of memory"
    )
    bench.add_argument("--dims", type=int, help="memory, index: of the embeddings (384)")
    bench.add_argument("--plot", metavar="FILE", help="memory: draw it")
    bench.add_argument("--page", metavar="FILE", help="results: (docs/results.md)")
    bench.add_argument("--methods", nargs="+", metavar="NAME", help="training runs: of these alone")
    bench.add_argument(
        "--runs",
        nargs="+",
        metavar="RUN",
        help="trajectories, buffer-vs-learning: run folders (the latter: those in --out)",
    )
    bench.add_argument(
        "--trust",
        action="store_true",
        default=None,
        help="trajectories: runs may name anything, and so run code",
    )
    bench.add_argument("--out", help="where runs and cells are kept (bench; faults: faults)")
    bench.add_argument(
        "--dry-run",
        action="store_true",
        default=None,
        help="training runs and kept cells: say which, and for how long",
    )
    bench.add_argument("--workers", type=int, help="training runs: so many at a time (1)")
    for part in ("kills", "disk", "files", "checkpoints", "pickles", "yaml", "archives", "numbers"):
        bench.add_argument(f"--{part}", type=int, metavar="N", help="faults: so many (all parts)")
    bench.add_argument("--ray", metavar="ADDRESS", help="training runs: on a Ray cluster, or local")
    for share, text in (("cpus", "CPUs (1)"), ("gpus", "GPUs (0)"), ("memory", "GiB (not asked)")):
        bench.add_argument(f"--{share}", type=float, metavar="N", help=f"--ray: a run's {text}")
    return parser


def default_demo(env: str) -> Path:
    """Where ``regil record`` puts a demonstration when it is not told."""
    return Path("demos") / f"{env.rpartition('/')[2]}.hdf5"


def _record(
    env: str,
    path: Path,
    seed: int,
    env_kwargs: dict[str, Any] | None = None,
    encoder_frame_size: int | None = None,
) -> None:
    """Record the scripted expert."""
    from regil_sb3.recording import record_expert

    _refuse_existing(path)
    demo = record_expert(
        env,
        seed=seed,
        env_kwargs=env_kwargs,
        encoder_frame_size=encoder_frame_size,
        progress=lambda line: print(line, file=sys.stderr),
    )
    demo.save(path)
    tried = demo.metadata["seeds_tried"]
    print(
        f"{path}: {len(demo)} frames, seed {demo.metadata['seed']}, "
        f"{tried} {'seed' if tried == 1 else 'seeds'} tried"
    )


def _refuse_existing(path: Path) -> None:
    if path.exists():
        raise ValueError(f"{path} exists already: choose another file with -o, or remove it")


def _record_as_asked(args: argparse.Namespace) -> None:
    from regil_sb3.recording import NoExpertError
    from regil_sb3.settings import pairs

    path = args.out or default_demo(args.env)
    env_kwargs = pairs(args.env_kwargs)
    if args.size is not None:
        env_kwargs["size"] = args.size
    _refuse_existing(path)
    if args.teleop is None:
        try:
            _record(args.env, path, args.seed, env_kwargs, args.encoder_size)
            return
        except NoExpertError:
            pass  # a person takes its place
    from regil_sb3.teleoperation import teleoperate

    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch(exist_ok=False)  # what cannot be written is said before a person's work
    path.unlink()
    device = args.teleop or "keyboard"
    try:
        demo = teleoperate(args.env, device, args.seed, env_kwargs, args.encoder_size, args.live)
    except ValueError as error:
        if args.teleop is not None:
            raise
        raise ValueError(f"no scripted expert, and not to be recorded by hand: {error}") from error
    if demo is None:
        print("nothing was recorded", file=sys.stderr)
        return
    try:
        demo.save(path)
    except OSError as error:
        kept = Path(tempfile.mkdtemp(prefix="regil-")) / path.name
        demo.save(kept)
        raise OSError(f"{path} cannot be written ({error}): the recording is {kept}") from error
    print(f"{path}: {len(demo)} frames, seed {demo.metadata['seed']}")


def _convert(args: argparse.Namespace) -> None:
    from regil_wrappers import formats

    if args.target.exists():
        raise ValueError(f"{args.target} exists already: name another, or remove it")
    chosen = ("episode", "camera", "observations")
    demo = formats.read(
        args.source,
        args.source_format,
        flip=args.flip,
        crop=args.crop,
        size=_one_or_two(args.size),
        encoder_size=_one_or_two(args.encoder_size),
        source_fps=_whole(args.source_fps),
        fps=_whole(args.fps),
        actions=args.actions,
        held=args.held,
        **{name: getattr(args, name) for name in chosen if getattr(args, name) is not None},
    )
    lost = formats.write(demo, args.target, args.format)
    kept = "no actions" if demo.actions is None else f"{len(demo.actions)} actions"
    height, width = demo.frames.shape[1:3]
    print(f"{args.target}: {len(demo)} frames of {height}x{width}, {kept}")
    if lost:
        print(f"not kept: {', '.join(lost)}", file=sys.stderr)


def _one_or_two(values: list[int] | None) -> int | list[int] | None:
    return values[0] if values is not None and len(values) == 1 else values


def _whole(rate: float | None) -> float | None:
    return int(rate) if rate is not None and rate.is_integer() else rate


def _train(args: argparse.Namespace) -> None:
    from regil_wrappers import Demonstration

    from regil_sb3 import process, training
    from regil_sb3.checkpoint.callback import Preempted
    from regil_sb3.robots.interfaces import RobotError
    from regil_sb3.run_folder import has_checkpoint, refuse_finished
    from regil_sb3.settings import encoder_size, make_settings

    process.keep_freed_memory()
    process.set_threads()
    if args.resume is None and not args.env:
        raise ValueError("--env is missing: name an environment, or --resume a run")
    own = ("env", "algo", "demo", "seed", "out", "preset", "steps", "set")
    given = [f"--{name}" for name in own if getattr(args, name) not in (None, [])]
    if args.resume is not None and given:
        raise ValueError(
            "--resume goes on with the run's own settings, in its folder: give it alone, without "
            + ", ".join(given)
        )
    if args.episodes < 1:
        raise ValueError(f"--episodes is {args.episodes}: at least 1 is needed")
    seed = args.seed or 0
    run = args.resume or args.out or Path("runs") / f"{args.env.rpartition('/')[2]}-{seed}"
    try:
        if args.resume is not None:
            training.resume(run)
        else:
            settings = make_settings(args.env, args.preset, seed, args.steps, args.set, args.algo)
            refuse_finished(run)
            demo, size = args.demo or default_demo(args.env), encoder_size(settings)
            if not demo.exists():
                try:
                    _record(args.env, demo, seed, settings.env_kwargs, size)
                except ValueError as error:
                    raise ValueError(
                        f"{demo} is not there ({error}): make one with `regil record`, "
                        "or name yours with --demo"
                    ) from error
            loaded = Demonstration.load(demo)
            height = loaded.frames.shape[1]
            if size is not None and loaded.encoder_frames is None and height < size:
                print(
                    f"{demo} holds pictures of {height} px alone, which are enlarged to {size} for "
                    f"the encoder: `regil record {args.env} --encoder-size {size}` keeps larger "
                    "ones, where the environment draws them",
                    file=sys.stderr,
                )
            training.train(settings, loaded, run)
    except (KeyboardInterrupt, Preempted, RobotError):
        if has_checkpoint(run):
            print(f"\nsaved; go on with: regil train --resume {run}", file=sys.stderr)
        elif (run / "model.zip").exists():
            print(f"\nthe model is in {run}: regil evaluate {run}", file=sys.stderr)
        raise
    _evaluate(run, args.episodes, trust=True)  # it was made here
    _report([run], None)


def _evaluate(run: Path, episodes: int, trust: bool = False) -> None:
    from regil_sb3 import process, training
    from regil_sb3.evaluation import METHODS
    from regil_sb3.model_card import write_card

    process.keep_freed_memory()
    if episodes < 1:
        raise ValueError(f"--episodes is {episodes}: at least 1 is needed")
    unsaved = None
    try:
        results = training.evaluate_run(run, episodes, trust)
    except training.UnsavedError as error:
        results, unsaved = error.results, error
    except KeyboardInterrupt:
        print(f"\nnot evaluated; later: regil evaluate {run}", file=sys.stderr)
        raise
    print(f"\nSuccess over {episodes} unseen episodes, {results['steps']} steps of learning:")
    for name, title in METHODS.items():
        if name in results:
            print(f"  {title:<15} {results[name]['success']:.2f}")
    if unsaved is not None:
        raise unsaved
    write_card(run)


def _report(runs: list[Path], out: Path | None) -> None:
    if len(runs) == 1:
        from regil_sb3.report import write_report

        print(f"report: {write_report(runs[0], out)}")
        return
    from regil_sb3.report import write_comparison

    out = out or Path(os.path.abspath(runs[0])).parent / "comparison.html"
    print(f"comparison: {write_comparison(runs, out)}")


def _push(run: Path, repo: str, private: bool) -> None:
    from regil_sb3.model_card import push

    def show(path: Path) -> None:
        print(f"  {path.name:<40} {path.stat().st_size / 1e6:8.2f} MB")

    print(push(run, repo, private, show))


def _doctor(args: argparse.Namespace) -> int:
    from regil_sb3 import doctor, process

    process.set_threads()
    overrides = [*args.set, *([] if args.image is None else [f"image={args.image}"])]
    return doctor.main(
        args.env, args.demo, args.episodes, overrides, args.preset, args.html, args.search
    )


def main(argv: list[str] | None = None) -> int:
    """Run a command; 0 when it worked, 2 for bad input (one line says what), 130 for Ctrl-C.

    75, "try again", where `train` was told to end (SIGTERM) and can go on with --resume.

    `doctor` also has 1: something is wrong with the demonstration.
    """
    args = _parser().parse_args(argv)
    from gymnasium.error import Error as GymnasiumError

    try:
        if args.command == "record":
            _record_as_asked(args)
        elif args.command == "convert":
            _convert(args)
        elif args.command == "doctor":
            return _doctor(args)
        elif args.command == "train":
            _train(args)
        elif args.command == "evaluate":
            _evaluate(args.run, args.episodes, args.trust)
        elif args.command == "report":
            _report(args.run, args.out)
        elif args.command == "push":
            _push(args.run, args.repo, args.private)
        elif args.command == "bench":
            from regil_sb3.bench import tables

            own = ("command", "table")
            given = {n: v for n, v in vars(args).items() if n not in own and v is not None}
            tables.main(args.table, **given)
    except KeyboardInterrupt:
        return 130
    except (
        ValueError,
        OSError,
        MemoryError,
        ArithmeticError,
        ImportError,
        GymnasiumError,
    ) as error:
        print(f"regil: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
