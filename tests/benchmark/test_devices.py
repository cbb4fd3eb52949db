"""Each worker takes a GPU of its own; a cluster of SLURM starts workers that do."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from hesim_render.benchmark import worker
from hesim_render.benchmark.worker import VISIBLE, claim_device, devices_of

CODE = """
import importlib.util, sys
from pathlib import Path
spec = importlib.util.spec_from_file_location("devices", sys.argv[2])  # alone, without what the package needs
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
claim_device = module.claim_device
found = {"CUDA_VISIBLE_DEVICES": "0,1,GPU-8f"}
print(claim_device(found, locks=Path(sys.argv[1])), found["CUDA_VISIBLE_DEVICES"], flush=True)
sys.stdin.read()
"""


def test_the_environment_comes_before_the_driver(tmp_path):
    for k in range(3):
        (tmp_path / f"0000:{k}").mkdir()
    assert devices_of({}, tmp_path) == ["0", "1", "2"]
    assert devices_of({VISIBLE: "2, GPU-8f"}, tmp_path) == ["2", "GPU-8f"]
    assert devices_of({VISIBLE: ""}, tmp_path) == [] and devices_of({}, tmp_path / "none") == []
    one = {VISIBLE: "1"}
    assert claim_device(one, locks=tmp_path) is None and one == {VISIBLE: "1"}


def test_workers_take_different_gpus_and_a_dead_one_gives_its_own_back(tmp_path):
    """Three processes have three GPUs; a fourth shares one; after a kill its GPU is free again."""

    def start():
        process = subprocess.Popen(
            [sys.executable, "-c", CODE, str(tmp_path), worker.__file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        device, visible = process.stdout.readline().split()
        assert device == visible
        return process, device

    workers = [start() for _ in range(3)]
    try:
        assert [device for _, device in workers] == ["0", "1", "GPU-8f"]
        workers.append(start())
        assert workers[3][1] in ("0", "1", "GPU-8f")
        workers[1][0].kill()
        workers[1][0].wait()
        workers.append(start())
        assert workers[4][1] == "1"
    finally:
        for process, _ in workers:
            process.kill()
            process.communicate()


def test_the_recipe_for_slurm_asks_for_what_workers_need():
    pytest.importorskip("dask_jobqueue")
    code = (
        "import runpy, sys; found = runpy.run_path(sys.argv[1]);"
        "print(found['cluster_of'](partition='gpu', minutes=90, memory='8GB', gpus=2).job_script())"
    )
    script = Path(__file__).parents[2] / "examples" / "slurm_benchmark.py"
    environment = {**os.environ, "PYTHONPATH": str(script.parents[1])}
    run = subprocess.run(
        [sys.executable, "-c", code, str(script)], capture_output=True, text=True, check=True, env=environment
    )
    lines = run.stdout.splitlines()
    assert "#SBATCH -p gpu" in lines and "#SBATCH -t 01:30:00" in lines and "#SBATCH --gres=gpu:2" in lines
    assert "#SBATCH --cpus-per-task=2" in lines and any(line.startswith("#SBATCH --mem=8G") for line in lines)
    command = next(line for line in lines if "distributed.cli.dask_worker" in line or "dask worker" in line)
    assert "--nthreads 1" in command and "--nworkers 2" in command  # one clip at a time in a process
