"""Build and check wheels and sdists of both distributions.

    python .ci/dist.py [FOLDER]     (dist)

From the same commit they are the same to the bit. All files get one time: SOURCE_DATE_EPOCH, else
that of the last commit. With that setuptools makes reproducible wheels, but no such sdists: these
are packed again, and wheels are built from them.
"""

from __future__ import annotations

import gzip
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

from build import ProjectBuilder
from build.env import DefaultIsolatedEnv

ROOT = Path(__file__).resolve().parents[1]


def git(*words: str) -> str:
    """What git says in this repository."""
    done = subprocess.run(["git", *words], cwd=ROOT, check=True, capture_output=True, text=True)
    return done.stdout


def packed_again(sdist: Path, out: Path, epoch: int) -> Path:
    """Write a copy of an sdist that depends on nothing but its files' names and contents."""
    with (
        tarfile.open(sdist) as old,
        (out / sdist.name).open("wb") as file,
        gzip.GzipFile(filename="", mode="wb", fileobj=file, mtime=epoch) as packed,
        tarfile.open(fileobj=packed, mode="w") as new,
    ):
        for member in sorted(old.getmembers(), key=lambda member: member.name):
            member.mtime = epoch
            member.uid = member.gid = 0
            member.uname = member.gname = ""
            member.mode = 0o755 if member.isdir() or member.mode & 0o100 else 0o644
            member.pax_headers = {}
            new.addfile(member, old.extractfile(member) if member.isfile() else None)
    return out / sdist.name


def main(out: Path) -> None:
    """Build both into a folder."""
    os.environ.setdefault("SOURCE_DATE_EPOCH", git("log", "-1", "--format=%ct").strip())
    epoch = int(os.environ["SOURCE_DATE_EPOCH"])
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, DefaultIsolatedEnv() as env:
        work = Path(folder)
        # What is tracked and nothing else: earlier builds leave lists of files behind
        for name in git("ls-files", "-z").rstrip("\0").split("\0"):
            target = work / "source" / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, target)
        for project in (work / "source/wrappers", work / "source"):
            builder = ProjectBuilder.from_isolated_env(env, project)
            env.install(builder.build_system_requires)
            env.install(builder.get_requires_for_build("sdist"))
            sdist = packed_again(Path(builder.build("sdist", work / "sdists")), out, epoch)
            with tarfile.open(sdist) as archive:
                archive.extractall(work / "unpacked", filter="data")
            unpacked = work / "unpacked" / sdist.name.removesuffix(".tar.gz")
            builder = ProjectBuilder.from_isolated_env(env, unpacked)
            env.install(builder.get_requires_for_build("wheel"))
            wheel = Path(builder.build("wheel", out))
            print(sdist, wheel, sep="\n")
        env.install(["twine>=6"])
        twine = [env.python_executable, "-m", "twine", "check", "--strict"]
        subprocess.run([*twine, *sorted(out.iterdir())], check=True)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "dist"))
