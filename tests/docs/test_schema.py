"""Schemas and the page of the scenario file: equal to the models and their reader."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from pydantic_core import PydanticUndefined
from support.files.runs import HEAD

from docs import schema
from mi_nerfattack.io.strict import parse_toml
from mi_nerfattack.scenario import attack, objective, objects, scenario, vehicle
from mi_nerfattack.scenario.scenario import Scenario
from mi_nerfattack.scenario.section import NamedCameraSection, Section

ROOT = Path(__file__).parents[2]
SCHEMAS = {name: schema.schema(model) for name, model in schema.MODELS.items()}
FILES = sorted([*ROOT.glob("scenes/*.toml"), *ROOT.glob("docs/examples/*.toml")])
TYPES = {"object": dict, "array": list, "string": str, "boolean": bool}
TYPES |= {"integer": int, "number": (int, float), "null": type(None)}
#: Rule, value and definitions; all but those of parts of a value.
RULES = {
    "$ref": lambda rule, x, defs: allows(defs[rule.rpartition("/")[2]], x, defs),
    "oneOf": lambda rule, x, defs: sum(allows(part, x, defs) for part in rule) == 1,
    "anyOf": lambda rule, x, defs: any(allows(part, x, defs) for part in rule),
    "const": lambda rule, x, defs: x == rule,
    "enum": lambda rule, x, defs: x in rule,
    "type": lambda rule, x, defs: (
        isinstance(x, TYPES[rule]) and isinstance(x, bool) <= (rule == "boolean")
    ),
    "required": lambda rule, x, defs: not isinstance(x, dict) or {*rule} <= x.keys(),
    "minItems": lambda rule, x, defs: len(x) >= rule,
    "maxItems": lambda rule, x, defs: len(x) <= rule,
    "minLength": lambda rule, x, defs: len(x) >= rule,
    "pattern": lambda rule, x, defs: re.search(rule, x),
    "minimum": lambda rule, x, defs: x >= rule,
    "maximum": lambda rule, x, defs: x <= rule,
    "exclusiveMinimum": lambda rule, x, defs: x > rule,
    "exclusiveMaximum": lambda rule, x, defs: x < rule,
}
NESTED = {"properties", "additionalProperties", "prefixItems", "items"}
WORDS = {"default", "description", "$defs", "$schema"}
#: Headings of docs/reference/scenario.md, and the models whose keys they list.
LISTED: dict[str, list[type[Section]]] = {
    "The scene": [scenario.SceneSection],
    "Objects": [objects.FieldObjectSection],
    "The camera": [NamedCameraSection],
    "The drive": [scenario.DriveSection],
    "The vehicle": [vehicle.DubinsSection],
    "The attack": [attack.AttackSection],
    "The search method": [
        attack.GradientMethod,
        attack.FrameMethod,
        attack.RandomMethod,
        attack.BlockMethod,
        attack.EvolutionMethod,
        attack.BayesianMethod,
    ],
    "What the attack may change": [attack.TextureFreedom, attack.PoseFreedom],
    "Variation": [objective.VarySection],
    "Sun and sky": [objective.SunSection],
    "The baseline": [scenario.BaselineSection],
}
#: Keys that are tables with a section or page of their own, or belong to one model.
ELSEWHERE = {"method", "freedom", "adjoint", "vary", "sun", "max_heading_rate"}


def allows(rule, value, defs) -> bool:
    if isinstance(rule, bool):
        return rule
    assert rule.keys() <= {*RULES, *NESTED, *WORDS}
    # `type` first: other rules are of values of that type
    names = sorted(rule.keys() & RULES.keys(), key=lambda name: name != "type")
    if not all(RULES[name](rule[name], value, defs) for name in names):
        return False
    children = []
    if isinstance(value, dict):
        own, extra = rule.get("properties", {}), rule.get("additionalProperties", True)
        children = [(own.get(key, extra), item) for key, item in value.items()]
    elif isinstance(value, list):
        first = rule.get("prefixItems", [])
        rules = [*first, *[rule.get("items", True)] * len(value)]
        children = list(zip(rules, value, strict=False))
    return all(allows(subrule, item, defs) for subrule, item in children)


def is_valid(name, values):
    return allows(SCHEMAS[name], values, SCHEMAS[name]["$defs"])


@pytest.mark.parametrize("path", schema.schemas(), ids=lambda path: path.name)
def test_the_file_is_equal_to_the_models(path):
    text = schema.schemas()[path]
    assert path.read_text("utf-8") == text, "run python docs/schema.py"


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_every_bundled_file_is_valid(path):
    values = parse_toml(path, path.read_text("utf-8"))
    assert is_valid("grid" if "scenario" in values else "scenario", values)


@pytest.mark.parametrize(
    ("text", "allowed"),
    [
        ("", True),
        ("[attack]\nmax_iterations = 3", False),
        ("[attack.method]\nmax_iterations = 3", True),
        ("[attack.method]\nmax_iterations = 0", False),
        ('[attack.method]\nkind = "blocks"\nfirst_block = 0.5', True),
        ("[attack.method]\nfirst_block = 0.5", False),
        ('[attack.method]\nkind = "block"', False),
        ('[attack.adjoint]\nkind = "kept_backgrounds"', True),
        ('[attack.adjoint]\nkind = "replay"\nsegment = 3', False),
        ('[vehicle]\nkind = "custom"\nfunction = "a.py:f"\ncontrol_limit = 1', True),
        ('[vehicle]\nkind = "custom"', False),
        ("[vehicle]\nspeed_ms = 3", True),
        ("[deployment]\nspp = 3", True),
        ('[[deployment]]\nspp = 3\n[[deployment]]\nkind = "mujoco"', True),
        ('[[deployment]]\nkind = "mujoco_gl"\nspp = 3', False),
        ('[[objective.term]]\nkind = "heading"\nweights = { kind = "end" }', True),
        ("[objective]\nterm = []", False),
        ("[objective.reduction]\nfraction = 0.5", False),
        ("[camera]\nwidth = 3.5", False),
        ("[camera]\nwdith = 3", False),
    ],
)
def test_the_schema_takes_what_the_reader_takes(text, allowed):
    values = parse_toml("test", f"{HEAD}{text}\n")
    assert is_valid("scenario", values) == allowed
    try:
        Scenario.model_validate(values)
    except ValueError:
        assert not allowed
    else:
        assert allowed


def test_the_suffix_tells_the_kind_of_a_policy():
    for file, key in (("a.onnx", "recurrent = [[-1, 3]]"), ("a.py:A", "batch = 1")):
        text = HEAD.replace("policy.safetensors", file) + key
        assert is_valid("scenario", parse_toml("test", text))


def listed(heading: str) -> set[tuple[str, str]]:
    """Return keys and defaults (JSON) of a section of the page; nothing for words."""
    page = (ROOT / "docs/reference/scenario.md").read_text("utf-8")
    _, _, section = page.partition(f"# {heading}\n")
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \|", section.partition("\n#")[0], re.M)
    return {
        (key, json.dumps(json.loads(x[1:-1])) if x[0] == "`" else "") for key, x in rows
    }


def with_defaults(models: list[type[Section]]) -> set[tuple[str, str]]:
    """Return keys and defaults (JSON) of models; nothing for none."""
    defaults: set[tuple[str, str]] = set()
    for model in models:
        for key, default in model.defaults().items():
            if key not in ELSEWHERE:
                none = default in (None, (), PydanticUndefined)
                defaults.add((key, "" if none else json.dumps(default)))
    return defaults


@pytest.mark.parametrize("heading", LISTED)
def test_the_page_lists_every_key_and_default(heading):
    kinds = {("kind", f'"{kind}"') for kind in ("gradient", "texture")} | {("kind", "")}
    assert listed(heading) - kinds == with_defaults(LISTED[heading]) - kinds


def test_the_page_lists_flat_objects():
    common = with_defaults([objects.AbstractObjectSection]) | {("kind", "")}
    flat = with_defaults([objects.FlatObjectSection]) - common
    assert listed("Billboards and patches") == flat
