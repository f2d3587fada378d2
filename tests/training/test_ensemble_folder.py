"""Which folders of an ensemble are finished seeds."""

from __future__ import annotations

from cpunet.training.ensemble_folder import finished_members
from cpunet.training.run_folder import INFO


def test_a_seed_stopped_while_it_was_put_in_place_counts_once(tmp_path) -> None:
    for name in ("seed_010", "seed_002", "seed_002.unfinished", "seed_1000"):
        (tmp_path / name).mkdir()
        (tmp_path / name / INFO).touch()
    names = [run.name for run in finished_members(tmp_path)]
    assert names == ["seed_002", "seed_010", "seed_1000"]
