"""The page of a policy shows what its card says, whatever things are called."""

from __future__ import annotations

import copy

from mi_nerfattack.io import files
from mi_nerfattack.report.pages.policy import page_text, training_facts
from mi_nerfattack.scenes import bundled
from mi_nerfattack.training.record import read_record

CARD = files.read_json(bundled("policy/pilotnet.card.json"))


def test_the_bundled_page_is_that_of_its_card():
    path = bundled("policy/pilotnet.md")
    assert page_text("pilotnet", CARD) == files.read_text(path)
    record = read_record(bundled("policy/pilotnet.json"))
    assert record is not None and training_facts(record) == CARD["training"]


def test_the_page_is_the_same_before_and_after_its_card_is_written():
    settings = CARD["settings"]
    scales = tuple(map(tuple, settings["roadside"]["scales"]))
    unwritten = {**settings, "roadside": {**settings["roadside"], "scales": scales}}
    card = {**CARD, "settings": unwritten}
    assert page_text("pilotnet", card) == page_text("pilotnet", CARD)


def test_names_neither_end_a_cell_nor_begin_an_element():
    card = copy.deepcopy(CARD)
    card["environments"]["a|b\n<script>"] = card["environments"].pop("mujoco")
    text = page_text("<net>", card)
    assert "| a\\|b &lt;script> |" in text and "<script" not in text
