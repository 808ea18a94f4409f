"""What a training writes down beside its policy."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.roadside import PaintedSite
from helpers.shards import write_shard

from mi_nerfattack.io import files
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.report.pages.policy import training_facts
from mi_nerfattack.training.imitate import Imitated, ImitationSettings
from mi_nerfattack.training.record import read_record, training_record, write_trained
from mi_nerfattack.training.validation import Epoch


@pytest.mark.parametrize(
    "text",
    ['{"schema": "1.0"}', '{"training": true}', '{"schema": 2, "training": [1]}', "[]"],
)
def test_another_program_s_file_beside_a_policy_is_no_record(tmp_path, text):
    (tmp_path / "net.json").write_text(text)
    assert read_record(tmp_path / "net.json") is None


def test_a_training_writes_down_its_data_and_settings(tmp_path):
    folder = files.make_folder(tmp_path / "round_0" / "painted")
    frames = np.zeros((12, 2, 2, 3), np.uint8)
    shard = write_shard(folder / "shard_0000", frames, [0] * 12, [0.0] * 12)
    settings = ImitationSettings({"painted": 12}, seed=5)
    row = Epoch(train_loss=2.0, held_out_loss=1.0, held_out_error=0.1, measured=True)
    rows = [[row, {**row, "held_out_loss": 0.5}]]
    result = Imitated(PilotNet(2).eval(), rows, 0, {}, [shard])
    record = training_record(settings, [PaintedSite()], tmp_path, result, "train it")
    write_trained(tmp_path / "net.safetensors", result.module, record)
    found = read_record(tmp_path / "net.json")
    assert found is not None
    assert found.model_dump() == record.model_dump(mode="json")
    nothing = training_record(settings, [], tmp_path / "empty", result, "")
    assert nothing.data == {"earlier/painted": 12}
    facts = training_facts(record)
    assert facts["command"] == "train it" and facts["seed"] == 5
    assert facts["augmentation"]["exposure_ev"] > 0
    assert facts["data"] == {"round_0/painted": 12}
    # those of the collections and trainings are others: theirs are overridden
    assert "frames" not in facts["settings"]["collecting"]
    assert "seed" not in facts["settings"]["collecting"]
    assert "seed" not in facts["settings"]["training"]
    kinds = [item["kind"] for item in facts["settings"]["cloning"]["sources"]]
    assert kinds == ["scattered", "expert"]
    (first,) = facts["rounds"]
    assert first == {"epochs": 2, "held_out_loss": 0.5, "closed_loop_error_m": None}
