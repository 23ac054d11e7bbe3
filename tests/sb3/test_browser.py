"""The pages in a real browser: they draw, they play, they say nothing wrong and ask nobody."""

from __future__ import annotations

import importlib
import re
import shutil
from pathlib import Path

import made_run
import pytest

from regil_sb3.bench import results
from regil_sb3.bench.page import figure, write
from regil_sb3.report.comparison import write_comparison
from regil_sb3.report.run_page import write_report

pytestmark = pytest.mark.browser

WIDTHS = {"phone": 390, "desktop": 1280}


@pytest.fixture(scope="module")
def browser():
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = next(filter(None, map(shutil.which, ("chromium", "google-chrome", "chrome"))), None)
    if path is None:
        pytest.skip("no Chromium here: apt-get install chromium")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def expect(browser):
    return importlib.import_module("playwright.sync_api").expect


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    runs = [made_run.run(folder / f"{i}", seed=i, solved=19 - i) for i in range(2)]
    wide = ["| " + " | ".join(["a column"] * 12) + " |"] * 3
    write(
        folder, "trajectories", {"runs": ["a/long/way/" * 20]}, wide, "b/long/way/" * 20, [{"x": 1}]
    )
    with figure(folder / "trajectories.png", columns=2):
        pass  # empty panels will do
    results.main(str(folder), str(folder / "results.md"))
    return {
        "report": write_report(runs[0]),
        "comparison": write_comparison(runs, folder / "comparison.html"),
        "results": folder / "results.html",
    }


def opened(browser, page: Path, scheme="light", width=1280):
    """The page, what its console said and what it asked for."""
    context = browser.new_context(
        color_scheme=scheme, viewport={"width": width, "height": 900}, offline=True
    )
    tab = context.new_page()
    said, asked = [], []
    tab.on("console", lambda message: said.append(message.text))
    tab.on("pageerror", lambda error: said.append(str(error)))
    tab.on("request", lambda request: asked.append(request.url))
    tab.goto(page.as_uri())
    return tab, said, asked


@pytest.mark.parametrize("width", WIDTHS.values(), ids=WIDTHS)
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", ["report", "comparison", "results"])
def test_a_page_of_any_width_in_any_theme(browser, pages, name, scheme, width):
    tab, said, asked = opened(browser, pages[name], scheme, width)
    assert [url for url in asked if not url.startswith(("file:", "data:"))] == []
    assert asked[0].startswith("file:")
    assert said == []
    # Nothing sticks out to the side
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    background, ink = tab.evaluate(
        "[getComputedStyle(document.body).backgroundColor, getComputedStyle(document.body).color]"
        ".map(c => c.match(/[0-9]+/g).slice(0, 3).reduce((sum, v) => sum + Number(v), 0))"
    )
    assert (background < ink) is (scheme == "dark")
    assert abs(background - ink) > 400  # of 765: it can be read
    tab.context.close()


def test_through_an_episode(browser, expect, pages):
    """Slider, matched frame, warping path, reward and films move together."""
    tab, said, _ = opened(browser, pages["report"])
    player = tab.locator(".player.aligned")
    label = player.locator(".now")

    def shown():
        return [player.locator("canvas").nth(i).screenshot() for i in range(2)]

    expect(label).to_have_text(
        re.compile("demonstration: frame [01], evaluation episode: frame 0, matched with [01]")
    )
    before = shown()
    player.locator(".time").fill("39")
    assert "evaluation episode: frame 39, matched with 29, reward " in label.text_content()
    assert "demonstration: frame 29" in label.text_content()  # the matched one
    after = shown()
    assert all(a != b for a, b in zip(before, after, strict=True))
    path = player.locator(".matrix .window").get_attribute("points").split()
    assert 5 <= len(path) <= 12
    dot = player.locator(".matrix .here")
    x, y = float(dot.get_attribute("cx")), float(dot.get_attribute("cy"))
    assert (x, y) == pytest.approx((50 + 29.5 * 400 / 30, 50 + 39.5 * 400 / 40))
    player.locator(".follow").uncheck()
    player.locator(".time").fill("7")
    assert "demonstration: frame 7, evaluation episode: frame 7" in label.text_content()
    # A click on the distances and on the reward goes there
    matrix = player.locator(".matrix").bounding_box()
    unit = matrix["width"] / 450
    tab.mouse.click(matrix["x"] + 200 * unit, matrix["y"] + (50 + 20.5 * 10) * unit)
    assert player.locator(".time").input_value() == "20"
    chart = player.locator(".chart").bounding_box()
    tab.mouse.click(chart["x"] + chart["width"] * 428 / 480, chart["y"] + 30)
    assert player.locator(".time").input_value() == "39"
    assert said == []
    tab.context.close()


def test_films_play_to_their_end(browser, expect, pages):
    tab, said, _ = opened(browser, pages["report"])
    kept = tab.locator(".player").nth(1)
    assert kept.locator("canvas").count() == 5
    kept.locator(".play").click()
    assert kept.locator(".play").text_content() == "Pause"
    expect(kept.locator(".now")).to_have_text("100 % of each episode", timeout=20_000)
    expect(kept.locator(".play")).to_have_text("Play")
    assert said == []
    tab.context.close()
