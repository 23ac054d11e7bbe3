from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from regil_wrappers import make_encoder, register_encoder
from regil_wrappers.encoders import cache, embed, encoder_names

FRAMES = np.random.default_rng(0).integers(0, 256, (6, 84, 96, 3), dtype=np.uint8)


pytestmark = pytest.mark.usefixtures("fresh_encoders")


class Mean:
    """Average colour; counts how many frames it has encoded."""

    slow = False

    def __init__(self, cache_key: str | None = "mean") -> None:
        self.cache_key = cache_key
        self.encoded = 0

    def encode(self, frames: np.ndarray) -> np.ndarray:
        self.encoded += len(frames)
        return frames.mean(axis=(1, 2)).astype(np.float32)


def test_pixels_is_the_small_picture() -> None:
    embeddings = make_encoder("pixels").encode(FRAMES)
    assert (embeddings.shape, embeddings.dtype) == ((6, 28 * 28 * 3), np.float32)
    small = cv2.resize(FRAMES[2], (28, 28), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(embeddings[2], small.ravel().astype(np.float32) / 255)
    np.testing.assert_array_equal(embeddings[2:3], make_encoder("pixels").encode(FRAMES[2:3]))


def test_registered_encoders_are_made_once() -> None:
    register_encoder("mean", Mean)
    assert "mean" in encoder_names()
    assert make_encoder("mean") is make_encoder("mean")
    for taken in ("mean", "pixels", "dinov3", "r3m-resnet18", "my:own", "my@own", "my?own"):
        with pytest.raises(ValueError, match=re.escape(taken)):
            register_encoder(taken, Mean)


def test_embeddings_are_cached_by_key_and_frames() -> None:
    encoder = Mean()
    first = embed(encoder, FRAMES)
    assert embed(encoder, FRAMES) is first
    assert embed(Mean(), FRAMES.copy()) is first
    assert encoder.encoded == 6
    changed = FRAMES.copy()
    changed[3, 0, 0, 0] ^= 255
    assert embed(encoder, changed) is not first
    assert embed(Mean("mean, other weights"), FRAMES) is not first
    assert encoder.encoded == 12
    with pytest.raises(ValueError, match="read-only"):
        first[0] = 0


def test_without_a_key_nothing_is_cached() -> None:
    encoder = Mean(cache_key=None)
    embed(encoder, FRAMES)
    embed(encoder, FRAMES)
    assert encoder.encoded == 12


def test_the_cache_forgets_the_oldest() -> None:
    for i in range(20):
        embed(Mean(f"mean {i}"), FRAMES)
    assert len(cache._cache) == cache._CACHED_DEMONSTRATIONS


def test_pixels_needs_no_file(tmp_path: Path) -> None:
    embed(make_encoder("pixels"), FRAMES)
    assert list(tmp_path.iterdir()) == []


def test_slow_encoders_keep_a_file(tmp_path: Path) -> None:
    encoder = Mean()
    encoder.slow = True
    first = embed(encoder, FRAMES)
    (file,) = tmp_path.rglob("*.npz")
    assert file.parent == tmp_path / "regil"
    cache._cache.clear()
    np.testing.assert_array_equal(embed(encoder, FRAMES), first)
    assert encoder.encoded == 6

    # A damaged or foreign file is written again.
    for damage in (b"", b"PK\x03\x04 nothing", file.read_bytes()[:-30]):
        cache._cache.clear()
        file.write_bytes(damage)
        encoder.encoded = 0
        np.testing.assert_array_equal(embed(encoder, FRAMES), first)
        assert encoder.encoded == 6
    cache._cache.clear()
    np.savez(file, embeddings=np.array([{"a": 1}], dtype=object))
    np.testing.assert_array_equal(embed(encoder, FRAMES), first)


def test_a_cache_that_cannot_be_written_costs_only_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    encoder = Mean()
    encoder.slow = True
    assert embed(encoder, FRAMES).shape == (6, 3)


@pytest.mark.parametrize(
    "output",
    [np.zeros((1, 3)), np.zeros(3, np.float32), np.zeros((2, 3), np.float32), [[0.0]]],
    ids=["float64", "one axis", "two rows", "list"],
)
def test_an_encoder_of_another_shape_is_refused(output: object) -> None:
    class Odd:
        def encode(self, frames: np.ndarray) -> object:
            return output

    with pytest.raises(ValueError, match="frame 0 of the demonstration: it must be a float32"):
        embed(Odd(), FRAMES)  # type: ignore[arg-type]


def test_importing_the_package_does_not_import_torch() -> None:
    code = "import sys, regil_wrappers; sys.exit('torch' in sys.modules or 'timm' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
