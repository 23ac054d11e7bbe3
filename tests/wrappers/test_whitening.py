"""PCA whitening: its equation, and that a whitened encoder belongs to one demonstration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from regil_wrappers import Demonstration, Retriever, make_encoder, register_encoder
from regil_wrappers.encoders import cache, embed, fitted, whitening
from regil_wrappers.encoders.pca import principal_axes

pytestmark = pytest.mark.usefixtures("fresh_encoders")

FRAMES = np.random.default_rng(0).integers(0, 256, (12, 40, 40, 3), dtype=np.uint8)
OTHER = np.random.default_rng(1).integers(0, 256, (12, 40, 40, 3), dtype=np.uint8)


@given(st.integers(3, 30), st.integers(2, 30), st.integers(0, 2**32 - 1))
def test_whitened_features_have_unit_covariance(rows: int, columns: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    scales = 2.0 ** rng.integers(0, 4, columns)
    x = (5 + rng.normal(size=(rows, columns)) * scales).astype(np.float32)
    n = max(1, min(rows - 1, columns) // 2)
    mean, axes = principal_axes(x, n)
    assert (mean.dtype, axes.dtype) == (np.float32, np.float32)
    y = (x - mean).astype(np.float64) @ axes
    np.testing.assert_allclose(y.T @ y / (rows - 1), np.eye(n), atol=1e-3)
    # The oracle: a singular value decomposition.
    _, s, vt = np.linalg.svd(x.astype(np.float64) - x.mean(axis=0, dtype=np.float64))
    expected = vt[:n].T * np.sqrt(rows - 1) / s[:n]
    expected *= np.sign(expected[np.abs(axes).argmax(axis=0), np.arange(n)])
    if n < len(s) and (s[:n] / s[1 : n + 1]).min() > 1.05:  # else axes may turn in their plane
        np.testing.assert_allclose(axes, expected, atol=1e-3 * np.abs(expected).max())


def test_too_many_axes_are_refused() -> None:
    with pytest.raises(
        ValueError, match=r"12 frames it is fitted on span 11 direc.*choose whiten=11 or"
    ):
        fitted(make_encoder("pixels?whiten=12"), FRAMES)
    fitted(make_encoder("pixels?whiten=11"), FRAMES)
    still = np.repeat(FRAMES[:1], 12, axis=0)
    with pytest.raises(ValueError, match="all are equal"):
        fitted(make_encoder("pixels?whiten=1"), still)
    with pytest.raises(ValueError, match=r"'pixels\?whiten=0': whiten=0: it must be a whole"):
        make_encoder("pixels?whiten=0")


def test_a_retriever_fits_it_on_its_own_demonstration() -> None:
    encoder = make_encoder("pixels?whiten=4")
    with pytest.raises(ValueError, match="is fitted on a demonstration"):
        encoder.encode(FRAMES)
    one = Retriever(Demonstration(FRAMES), "pixels?whiten=4")
    two = Retriever(Demonstration(OTHER), encoder)
    assert one.embeddings.shape == (12, 4)
    for retriever, frames in ((one, FRAMES), (two, OTHER)):
        assert [retriever.step(frame).cost for frame in frames] == [0] * 12
        covariance = np.cov(retriever.embeddings.T)
        np.testing.assert_allclose(covariance, np.eye(4), atol=1e-3)
    again = Retriever(Demonstration(FRAMES), "pixels?whiten=4")
    np.testing.assert_array_equal(again.embeddings, one.embeddings)


def test_a_batch_gives_the_same_bits() -> None:
    encoder = fitted(make_encoder("pixels?whiten=4"), FRAMES)
    one_by_one = np.concatenate([encoder.encode(OTHER[i : i + 1]) for i in range(12)])
    np.testing.assert_array_equal(encoder.encode(OTHER), one_by_one)


def test_several_demonstrations_are_fitted_together() -> None:
    encoder = fitted(make_encoder("pixels?whiten=4"), iter([FRAMES, OTHER]))
    both = encoder.encode(np.concatenate([FRAMES, OTHER]))
    np.testing.assert_allclose(np.cov(both.T), np.eye(4), atol=1e-3)
    retriever = Retriever([Demonstration(FRAMES), Demonstration(OTHER)], "pixels?whiten=4")
    np.testing.assert_array_equal(retriever.embeddings, both)


@pytest.mark.parametrize("rows", [3, 7, 24])
def test_of_many_frames_evenly_spaced_ones_are_fitted_on(
    rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(whitening, "_FITTED_BYTES", rows * 28 * 28 * 3 * 4)
    step = {3: 8, 7: 4, 24: 1}[rows]
    parts = [FRAMES[:5], FRAMES[5:6], FRAMES[6:], OTHER]
    some = fitted(make_encoder("pixels?whiten=2"), parts)
    monkeypatch.undo()
    expected = fitted(make_encoder("pixels?whiten=2"), np.concatenate([FRAMES, OTHER])[::step])
    np.testing.assert_array_equal(some.encode(OTHER), expected.encode(OTHER))


def test_others_are_left_as_they_are() -> None:
    encoder = make_encoder("pixels")
    assert fitted(encoder, FRAMES) is encoder


def test_the_key_tells_one_fit_from_another() -> None:
    first = fitted(make_encoder("pixels?whiten=4"), FRAMES)
    keys = {
        encoder.cache_key  # type: ignore[attr-defined]
        for encoder in (
            first,
            make_encoder("pixels"),
            fitted(make_encoder("pixels?whiten=5"), FRAMES),
            fitted(make_encoder("pixels?whiten=4"), OTHER),
            fitted(make_encoder("pixels?whiten=4&size=14"), FRAMES),
        )
    }
    assert len(keys) == 5
    assert fitted(make_encoder("pixels?whiten=4"), FRAMES).cache_key == first.cache_key  # type: ignore[attr-defined]


def test_a_slow_encoders_features_and_axes_are_kept_in_files(tmp_path: Path) -> None:
    class Slow:
        slow = True
        cache_key = "slow"
        encoded = 0

        def encode(self, frames: np.ndarray) -> np.ndarray:
            Slow.encoded += len(frames)
            return frames[:, 0, :8, 0].astype(np.float32)

    register_encoder("slow", Slow)
    first = embed(fitted(make_encoder("slow?whiten=3"), FRAMES), FRAMES)
    assert Slow.encoded == 12
    assert len(list(tmp_path.rglob("*.npz"))) == 2
    (axes,) = tmp_path.rglob("whitening-*.npz")
    cache._cache.clear()
    np.testing.assert_array_equal(
        embed(fitted(make_encoder("slow?whiten=3"), FRAMES), FRAMES), first
    )
    assert Slow.encoded == 12
    # What is stored is what is used: so that two processes agree to the last bit.
    with np.load(axes) as arrays:
        doubled = {"mean": arrays["mean"], "axes": 2 * arrays["axes"]}
    np.savez(axes, **doubled)
    np.testing.assert_array_equal(
        embed(fitted(make_encoder("slow?whiten=3"), FRAMES), FRAMES), 2 * first
    )
    axes.write_bytes(b"damaged")
    np.testing.assert_array_equal(
        embed(fitted(make_encoder("slow?whiten=3"), FRAMES), FRAMES), first
    )
