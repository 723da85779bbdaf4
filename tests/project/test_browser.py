"""The page and the viewer in a real browser."""

import contextlib
import time

import numpy as np
import pytest
from chromium import colours, element, faults, picture, prefer, wait_for
from kept_runs import HOSTILE, renamed
from selenium.webdriver.common.action_chains import ActionChains

from jaxsfm.cli.main import main
from jaxsfm.report.finished_run import read_run

pytestmark = pytest.mark.slow
FIGURES = ("model", "reprojection")


@pytest.fixture(scope="module")
def opened(browser, plain, scene, tmp_path_factory):
    """The browser with the page of a run, one of whose photos has a hostile name."""
    to = tmp_path_factory.mktemp("hostile")
    out, _ = renamed(plain[0], scene / "images", to, "view0.png", HOSTILE)
    assert main(["report", str(out)]) == 0
    browser.get((out / "report.html").as_uri())
    wait_for(lambda: browser.execute_script("return document.documentElement.dataset.drawnAfterMs"))
    return browser


def test_the_page_draws_every_figure_without_a_fault_or_a_network(opened):
    assert faults(opened) == []
    for name in FIGURES:
        assert element(opened, f"#{name} .main-svg").is_displayed()
        assert colours(picture(opened, f"#{name}")) > 8, name
    asked = opened.execute_script(
        "return performance.getEntriesByType('resource').map(e => e.name)"
        ".filter(name => !/^(data|blob):/.test(name))"
    )
    assert asked == []


def test_the_model_has_points_and_cameras_in_colours(opened):
    model = picture(opened, "#model")[60:]  # below the legend
    ground = np.median(model.reshape(-1, 3), axis=0)
    drawn = (np.abs(model.astype(int) - ground).max(2) > 30).mean()
    assert colours(model) > 60 and drawn > 0.01
    blue = (np.abs(model.astype(int) - [0x3B, 0x82, 0xC4]).max(2) < 12).sum()
    assert blue > 50  # the cameras' colour


def test_photos_and_matches_are_seen(opened):
    for selector in ("svg.pair", "td.thumb img"):
        rgb = picture(opened, selector)
        assert colours(rgb) > 30 and rgb.std() > 10, selector


def test_a_hostile_name_stays_a_name(opened):
    assert opened.title.endswith("jaxsfm report")
    assert opened.find_elements("css selector", "img[src=x]") == []
    assert HOSTILE in element(opened, "#photos").text
    assert HOSTILE in element(opened, "#matches").text


def test_the_page_follows_the_readers_colours_and_width(opened):
    ink = "return document.querySelector('#reprojection .xtick text').style.fill"
    ground = "return getComputedStyle(document.body).backgroundColor"
    light = [opened.execute_script(script) for script in (ink, ground)]
    prefer(opened, "dark")
    try:
        wait_for(lambda: opened.execute_script(ink) != light[0])
        assert opened.execute_script(ground) != light[1]
    finally:
        prefer(opened, "light")
    size = {"height": 900, "deviceScaleFactor": 1, "mobile": False}
    opened.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", {"width": 380, **size})
    try:
        # Nothing sticks out, once figures are drawn anew; tables scroll in their cards.
        fits = "return innerWidth == 380 && document.documentElement.scrollWidth <= innerWidth"
        wait_for(lambda: opened.execute_script(fits))
    finally:
        opened.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


@contextlib.contextmanager
def shown(run):
    """The viewer of a run on a free port."""
    viser = pytest.importorskip("viser", reason="the extra view is not installed")
    from jaxsfm.report.viewer import Viewer

    server = viser.ViserServer(host="127.0.0.1", port=18080, verbose=False)
    try:
        yield Viewer(server, run)
    finally:
        server.stop()


def test_the_viewer_shows_the_model_and_looks_through_a_clicked_camera(browser, plain, scene):
    run = read_run(plain[0], reference=scene / "reference")
    with shown(run) as viewer:
        browser.get(f"http://127.0.0.1:{viewer.server.get_port()}")
        wait_for(lambda: "3 cameras" in browser.find_element("tag name", "body").text)
        wait_for(lambda: browser.find_elements("css selector", "canvas"))
        wait_for(lambda: colours(picture(browser, "canvas")) > 60)
        text = browser.find_element("tag name", "body").text
        for control in ("Point size", "Show cameras", "Show reference", "Size of cameras"):
            assert control in text
        client = next(iter(viewer.server.get_clients().values()))
        for k in range(20):  # the first ones may come before the page is ready for them
            camera = viewer.scene.cameras[k % 3]
            ahead = viewer.scene.frustum_depth * camera.pose.rotation[2]
            click(browser, element(browser, "canvas"), client, camera.pose.centre + ahead)
            time.sleep(0.3)
            if viewer.through.value:
                break
        assert viewer.through.value in {c.name for c in viewer.scene.cameras}
        chosen = next(c for c in viewer.scene.cameras if c.name == viewer.through.value)
        near = 0.05 * viewer.scene.frustum_depth
        wait_for(lambda: np.abs(client.camera.position - chosen.pose.centre).max() < near)
        assert faults(browser) == []


def click(browser, canvas, client, at: np.ndarray) -> None:
    """Click where a world point is seen."""
    from viser.transforms import SO3

    local = SO3(client.camera.wxyz).as_matrix().T @ (at - client.camera.position)
    assert local[2] > 0
    half = canvas.size["height"] / 2 / np.tan(client.camera.fov / 2)
    x, y = (round(float(v)) for v in half * local[:2] / local[2])
    moves = ActionChains(browser, duration=50).move_to_element_with_offset(canvas, x - 3, y)
    moves.pause(0.2).move_by_offset(3, 0).pause(0.2).click().perform()


def test_the_viewer_says_what_it_lacks(plain, capsys, monkeypatch):
    import sys

    assert main(["view", str(plain[0]), "--port", "0"]) == 2
    assert "--port must lie in 1 .. 65535; got 0" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["view", str(plain[0])]) == 2
    assert "jaxsfm view needs viser: pip install 'jaxsfm[view]'" in capsys.readouterr().err


def test_an_address_that_cannot_be_listened_on_is_one_sentence(plain, capsys):
    assert main(["view", str(plain[0]), "--host", "203.0.113.1"]) == 2  # of no machine
    error = capsys.readouterr().err
    assert "--host 203.0.113.1" in error and "Traceback" not in error
