"""The beginning of a scenario file, and the files that it names."""

from __future__ import annotations

HEAD = """\
name = "test"
[scene]
field = "scene.safetensors"
deployment = "deployment.xml"
routes = "routes.json"
route = "lane"
[[objects]]
id = "hydrant"
field = "object.safetensors"
position_m = [1.0, 2.0, 0.0]
[policy]
file = "policy.safetensors"
"""


def write_named_files(folder):
    """Write files that have content, and no use."""
    for name in ("scene", "object", "policy"):
        (folder / f"{name}.safetensors").write_bytes(name.encode())
    (folder / "routes.json").write_text("{}")
    (folder / "deployment.xml").write_text('<scene version="3.0.0"/>')
