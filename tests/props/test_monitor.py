"""Monitor images, measured in pixels, and the page in a browser."""

from __future__ import annotations

import subprocess

import numpy as np
import pytest
from support.pages.browser import chromium

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.props.monitor import Screen, screen_image, screen_page

FACE = np.full((64, 64, 3), (200, 30, 30), np.uint8)


def measured(image: np.ndarray, screen: Screen) -> np.ndarray:
    """Return left, top, width and height of what is not black, millimetres."""
    rows, columns = np.nonzero(image.max(2) > 40)
    density = np.array(screen.px_per_mm)
    first = np.array([columns.min(), rows.min()]) / density
    last = np.array([columns.max() + 1, rows.max() + 1]) / density
    return np.concatenate([first, last - first])


@pytest.mark.parametrize(
    ("screen", "diagonal"),
    [
        (Screen(), 27.0),
        (Screen(1920, 1200, 24.0, 16 / 10), 24.0),
        (Screen(1280, 1440, 27.0, 16 / 9), 27.0),  # pixels that are not square
    ],
)
@pytest.mark.parametrize("size", [(300.0, 300.0), (87.3, 120.0)])
def test_size_and_place(screen, diagonal, size):
    assert np.hypot(*screen.size_mm) == pytest.approx(25.4 * diagonal)
    assert screen.size_mm[0] / screen.size_mm[1] == pytest.approx(screen.aspect)
    image = screen_image(screen, FACE, size)
    assert image.shape == (screen.height_px, screen.width_px, 3)
    left, top, width, height = measured(image, screen)
    assert (width, height) == pytest.approx(size, abs=0.5)
    middle = left + width / 2, top + height / 2
    assert middle == pytest.approx(np.array(screen.size_mm) / 2, abs=0.5)


def test_gamma_and_background():
    grey = np.full((4, 4, 3), 128, np.uint8)
    screen = Screen(64, 36, gamma=2.2)
    image = screen_image(screen, grey, (100.0, 100.0), (9, 8, 7))
    linear = ((128 / 255 + 0.055) / 1.055) ** 2.4
    assert image[18, 32].tolist() == [round(255 * linear ** (1 / 2.2))] * 3
    assert image[0, 0].tolist() == [9, 8, 7]
    plain = screen_image(Screen(64, 36), grey, (100.0, 100.0))
    assert plain[18, 32].tolist() == [128] * 3


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: screen_image(Screen(), FACE, (400.0,) * 2), r"at most 336\.\d mm"),
        # of a longer box
        (
            lambda: screen_image(Screen(), FACE, (400.0,) * 2, (0,) * 3, 800.0),
            r" 672\.",
        ),
        (lambda: screen_image(Screen(), FACE, (9.0,) * 2, (0, 256, 0)), "--background"),
        (lambda: Screen(width_px=0), "--pixels"),
        (lambda: Screen(diagonal_in=-1.0), "--diagonal"),
        (lambda: Screen(gamma=0.0), "--gamma"),
    ],
)
def test_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [1, 2])
def test_page_in_a_browser(tmp_path, ratio):
    """Pixel by pixel; it warns unless window and scale are the monitor's."""
    screen = Screen(1280, 720)
    image = screen_image(screen, FACE, (150.0, 150.0))
    page, shot = tmp_path / "a.html", tmp_path / "a.png"
    page.write_text(screen_page(image, "a <face>"))
    size = f"--window-size={1280 // ratio},{720 // ratio}"
    scale = f"--force-device-scale-factor={ratio}"
    still = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
    still += [f"--user-data-dir={tmp_path / 'profile'}", size, scale]
    for output in (f"--screenshot={shot}", "--dump-dom"):
        done = subprocess.run(
            [chromium(), *still, output, page.as_uri()],
            capture_output=True,
            text=True,
            timeout=120,
            check=True,
        )
    shown = files.read_image(shot)[..., :3]
    expected = measured(image, screen)
    rows = slice(0, min(600, len(shown)))  # above the warning
    np.testing.assert_allclose(
        measured(np.where(shown == [255, 255, 0], 0, shown)[rows], screen)[:3],
        expected[:3],
        atol=0.01,
    )
    np.testing.assert_array_equal(shown[200:500, :1280], image[200:500])
    assert ("scales by 2" in done.stdout) == (ratio == 2)
    assert "a &lt;face&gt;" in done.stdout
