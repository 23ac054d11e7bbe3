"""An encoder's name: its grammar, its options, and the user's own encoders."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from regil_wrappers import make_encoder, register_encoder
from regil_wrappers.encoders import Preprocessing, encoder_names, runs_code
from regil_wrappers.encoders.options import absolute, parse

pytestmark = pytest.mark.usefixtures("fresh_encoders")

FRAMES = np.random.default_rng(0).integers(0, 256, (3, 40, 50, 3), dtype=np.uint8)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("pixels", ("pixels", None, {})),
        ("dinov3@a/b.pth", ("dinov3", "a/b.pth", {})),
        ("dinov3@a?b.pth?whiten=3", ("dinov3", "a?b.pth", {"whiten": 3})),
        ("torchscript:me@home.pt", ("torchscript:me@home.pt", None, {})),
        (
            "x?a=1&b=.5&c=true&d=None&e=.5,.5,.5&f=cuda:1&g=a=b",
            (
                "x",
                None,
                dict(a=1, b=0.5, c=True, d=None, e=(0.5, 0.5, 0.5), f="cuda:1", g="a=b"),
            ),
        ),
    ],
)
def test_a_name_comes_apart(text: str, parts: tuple[object, ...]) -> None:
    assert parse(text) == parts


@given(st.dictionaries(st.from_regex(r"[a-z_]{1,5}", fullmatch=True), st.integers(), min_size=1))
def test_options_survive_the_string(options: dict[str, int]) -> None:
    tail = "&".join(f"{key}={value}" for key, value in options.items())
    assert parse(f"pixels?{tail}") == ("pixels", None, options)


@pytest.mark.parametrize("text", ["pixels?", "pixels?size", "pixels?size=", "pixels?size=9&size=9"])
def test_what_is_no_option_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"is no option: write name\?option=value"):
        make_encoder(text)


def test_unknown_names_list_those_that_exist() -> None:
    with pytest.raises(ValueError, match=r"'pixel'.*'clip-vit-b32'.*'pixels'.*timm:<model>") as e:
        make_encoder("pixel")
    assert all(name in str(e.value) for name in encoder_names())
    assert "\n" not in str(e.value)


def test_unknown_options_list_those_that_exist() -> None:
    with pytest.raises(ValueError, match=r"'pixels\?sise=9'.*'sise'.*\['size', 'whiten'\]"):
        make_encoder("pixels?sise=9")
    for name in ("r3m-resnet18", "efficientnet-lite0", "torchscript:x", "dinov3"):
        with pytest.raises(ValueError, match=r"'sise'.*'batch', 'compile'.*'device'.*'precision'"):
            make_encoder(name, sise=9)
    with pytest.raises(ValueError, match="it reads no file"):
        make_encoder("pixels@weights.pth")


def test_options_out_of_range_are_refused_before_anything_is_loaded() -> None:
    with pytest.raises(ValueError, match=r"'pixels.size=0': size=0: it must be a whole number"):
        make_encoder("pixels?size=0")
    for options, match in (
        (dict(size=1.5), "size=1.5"),
        (dict(size=9, crop=0), "crop=0"),
        (dict(size=9, mean=(1, 2)), "three"),
        (dict(size=9, std=0), "above 0"),
        (dict(size=9, order="gbr"), r"order='gbr': choose one of \['rgb', 'bgr'\]"),
    ):
        with pytest.raises(ValueError, match=match):
            Preprocessing(**options)  # type: ignore[arg-type]


def test_keywords_and_string_say_the_same() -> None:
    assert make_encoder("pixels?size=7").encode(FRAMES).shape == (3, 7 * 7 * 3)
    assert make_encoder("pixels", size=7).cache_key == make_encoder("pixels?size=7").cache_key  # type: ignore[attr-defined]
    assert make_encoder("pixels?size=7", size=8).encode(FRAMES).shape == (3, 8 * 8 * 3)


def test_preprocessing_crops_and_orders() -> None:
    plain = Preprocessing(None).pictures(FRAMES)
    np.testing.assert_array_equal(plain, FRAMES)
    cropped = Preprocessing(None, crop=0.5).pictures(FRAMES)  # 20 of the shorter side's 40
    np.testing.assert_array_equal(cropped, FRAMES[:, 10:30, 15:35])
    assert Preprocessing(32, crop=0.5).frame_size == 64
    assert Preprocessing(32).pictures(FRAMES).shape == (3, 32, 32, 3)
    swapped = Preprocessing(None, order="bgr").pictures(FRAMES)
    np.testing.assert_array_equal(swapped, FRAMES[..., [2, 1, 0]])
    assert swapped.flags.c_contiguous
    assert Preprocessing(9, mean=0.5).mean == (0.5, 0.5, 0.5)  # type: ignore[arg-type]


@pytest.fixture
def own_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_encoders.py").write_text(
        "import numpy as np\n"
        "class Corner:\n"
        "    def __init__(self, side=2):\n"
        "        self.side = side\n"
        "    def encode(self, frames):\n"
        "        corner = frames[:, :self.side, :self.side]\n"
        "        return corner.reshape(len(frames), -1).astype(np.float32)\n"
        "number = 3\n"
        "def three():\n"
        "    return number\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "my_encoders", raising=False)


@pytest.mark.usefixtures("own_module")
def test_module_and_function_name_the_users_own() -> None:
    assert make_encoder("my_encoders:Corner").encode(FRAMES).shape == (3, 12)
    assert make_encoder("my_encoders:Corner?side=3").encode(FRAMES).shape == (3, 27)
    for name, match in (
        ("my_encoders:Corner?length=3", r"no option 'length': choose one of \['side', 'whiten'\]"),
        ("my_encoders:absent", "module 'my_encoders' has no function 'absent'"),
        ("my_encoders:number", "has no function 'number'"),
        ("my_encoders:three", r"'my_encoders:three': it makes 3, which has no encode\(frames\)"),
        ("my_encoders:three?whiten=2", "it makes 3"),
    ):
        with pytest.raises(ValueError, match=match):
            make_encoder(name)
    with pytest.raises(ImportError, match=r"'absent:f': there is no module 'absent'.*PYTHONPATH"):
        make_encoder("absent:f")


def test_a_registered_factory_takes_options() -> None:
    class Sized:
        def __init__(self, size: int = 1) -> None:
            self.size = size

        def encode(self, frames: np.ndarray) -> np.ndarray:
            return np.zeros((len(frames), self.size), np.float32)

    register_encoder("sized", Sized)
    assert make_encoder("sized?size=5").encode(FRAMES).shape == (3, 5)


def test_names_that_run_code() -> None:
    assert runs_code("os:system")
    assert runs_code("os:system?command=true")
    assert runs_code("torchscript:net.pt")
    assert not any(map(runs_code, ("pixels", "timm:resnet18@x:y.pth", "dinov3@a:b?whiten=3")))


def test_a_file_in_a_name_is_told_from_the_root(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("r3m-resnet18@{}r3m-resnet18?batch=8", "torchscript:{}a.pt?batch=2", "pixels?x=a"):
        told = absolute(name.format("w/"))
        assert told == name.format(f"{tmp_path}/w/")
        assert absolute(told) == told
    assert absolute("pixels") == "pixels"
