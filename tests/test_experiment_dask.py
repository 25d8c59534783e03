"""The same sweep on a Dask cluster."""

from pathlib import Path

import pytest

from test_experiment import SWEEP, contents
from test_experiment_spec import planned
from zfusion.studies.experiment.engines import engine_of, one_by_one
from zfusion.studies.experiment.run import run_experiment


@pytest.mark.timeout(120)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_dask_cluster_gives_the_same_tables(tmp_path: Path) -> None:
    made = planned(tmp_path, SWEEP)
    outcome = run_experiment(made, tmp_path / "dask", engine_of("simulated", 1, dask="local"))
    assert (outcome.done, outcome.failed, outcome.interrupted) == (8, [], False)
    run_experiment(made, tmp_path / "here", one_by_one)
    assert contents(tmp_path / "dask") == contents(tmp_path / "here")
