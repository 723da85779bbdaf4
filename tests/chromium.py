"""A headless Chromium for tests, by Selenium and the system's own driver."""

import base64
import contextlib
import os
import shutil
import tempfile
import time
from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from selenium import webdriver
from selenium.common.exceptions import NoSuchElementException, StaleElementReferenceException
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.remote.webelement import WebElement

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--enable-unsafe-swiftshader",  # WebGL without a graphics card
    "--window-size=1200,900",
    "--hide-scrollbars",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
)


def _found(*names: str) -> str | None:
    return next((path for name in names if (path := shutil.which(name))), None)


@contextlib.contextmanager
def started() -> Iterator[webdriver.Chrome]:
    """Start the browser; without one, or without a driver that fits it, the test is skipped."""
    binary = _found("chromium", "chromium-browser", "google-chrome")
    driver = _found("chromedriver")
    if binary is None or driver is None:
        pytest.skip("no Chromium with chromedriver: install chromium and chromium-driver (Debian)")
    options = webdriver.ChromeOptions()
    options.binary_location = binary
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        for flag in (*FLAGS, f"--user-data-dir={profile}"):
            options.add_argument(flag)
        chrome = webdriver.Chrome(options=options, service=Service(driver, log_output=os.devnull))
        try:
            yield chrome
        finally:
            chrome.quit()


def faults(chrome: webdriver.Chrome) -> list[str]:
    """The errors in the console since the last call."""
    return [row["message"] for row in chrome.get_log("browser") if row["level"] == "SEVERE"]


def prefer(chrome: webdriver.Chrome, scheme: str) -> None:
    """Make the pages light or dark."""
    features = [{"name": "prefers-color-scheme", "value": scheme}]
    chrome.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})


def wait_for(condition, seconds: float = 60.0):
    """The condition's value once it is true. What is not there yet (a page without its body), or
    was drawn anew while it was looked at, is waited for too."""
    end = time.monotonic() + seconds
    while True:
        try:
            if value := condition():
                return value
            missing = "nothing came"
        except (NoSuchElementException, StaleElementReferenceException) as error:
            missing = str(error.msg)
        assert time.monotonic() < end, missing
        time.sleep(0.1)


def element(chrome: webdriver.Chrome, selector: str) -> WebElement:
    """The first element that a selector finds."""
    return chrome.find_element("css selector", selector)


def picture(chrome: webdriver.Chrome, selector: str) -> np.ndarray:
    """uint8 (h, w, 3), RGB, of an element. Not by Selenium, which scrolls it into view: slow where
    WebGL is drawn by the processor."""
    box = chrome.execute_script(
        "const r = arguments[0].getBoundingClientRect();"
        "return {x: r.x + scrollX, y: r.y + scrollY, width: r.width, height: r.height, scale: 1}",
        element(chrome, selector),
    )
    shot = chrome.execute_cdp_cmd(
        "Page.captureScreenshot", {"format": "png", "captureBeyondViewport": True, "clip": box}
    )
    png = base64.b64decode(shot["data"])
    bgr = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert bgr is not None
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def colours(rgb: np.ndarray) -> int:
    """The number of clearly different colours in a picture."""
    return len(np.unique(rgb.reshape(-1, 3) // 16, axis=0))
