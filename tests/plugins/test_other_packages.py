"""Another package of Mitsuba plugins beside ours, in any order of imports."""

from __future__ import annotations

import subprocess
import sys

import pytest

#: mitransient asks to be imported after Mitsuba, once a variant is set.
ORDERS = {
    "theirs, ours": """\
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import mitransient
import mi_nerfattack
""",
    "ours, theirs": """\
import mi_nerfattack
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import mitransient
""",
    "ours, theirs, another variant": """\
import mitsuba as mi
import mi_nerfattack
mi.set_variant("scalar_rgb")
mi.set_variant("llvm_ad_rgb")
import mitransient
""",
}
LOAD = """\
theirs = mi.load_dict({"type": "transient_path", "max_depth": 3})
from mi_nerfattack.scenes import bundled
path = str(bundled("hydrant/field.safetensors"))
field = mi.load_dict({"type": "grid_field", "filename": path})
ours = mi.load_dict({"type": "field_integrator", "field": field})
print(type(theirs).__name__, type(ours).__name__)
"""


@pytest.mark.parametrize("order", ORDERS)
def test_both_load(order):
    result = subprocess.run(
        [sys.executable, "-c", ORDERS[order] + LOAD], capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == ["TransientPath", "FieldIntegrator"]
