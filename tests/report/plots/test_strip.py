"""The strip of first-person frames shows exactly the pixels that it was given."""

from __future__ import annotations

import numpy as np

from mi_nerfattack.io import files
from mi_nerfattack.report.plots import strip


def test_strip_doubles_frames_exactly(tmp_path):
    rng = np.random.default_rng(3)
    frames = [rng.integers(0, 256, (66, 200, 3), dtype=np.uint8) for _ in range(2)]
    path = tmp_path / "strip.png"
    strip.first_person_strip(path, {"a": frames, "longer\nlabel": frames[:1]}, [0, 1.5])
    image = files.read_image(path)
    doubled = np.kron(frames[1], np.ones((2, 2, 1), dtype=np.uint8))
    left = image.shape[1] - strip.GAP_PX - 400
    top = strip.FONT_PX + 2 * strip.GAP_PX
    np.testing.assert_array_equal(image[top : top + 132, left : left + 400], doubled)
    below = image[top + 138 : top + 270, left : left + 400]
    assert (below == 225).all()
    # Nothing is written outside the label column, the header and the frames.
    assert (image[top:, left - strip.GAP_PX : left] == 255).all()
