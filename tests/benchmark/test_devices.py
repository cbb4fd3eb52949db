"""Each worker takes a GPU of its own; a cluster of SLURM starts workers that do."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from hesim_render.benchmark.worker import VISIBLE, claim_device, devices_of

#: Loads the module once, and starts a process for each line that it reads; "PID" ends that process.
CODE = """
import os, signal, sys
from pathlib import Path
from hesim_render.benchmark.worker import claim_device

workers = []
for line in sys.stdin:
    if line.strip():
        os.kill(int(line), signal.SIGKILL)
        os.waitpid(int(line), 0)
        workers.remove(int(line))
        print("gone", flush=True)
        continue
    workers.append(os.fork())
    if workers[-1] == 0:
        found = {"CUDA_VISIBLE_DEVICES": "0,1,GPU-8f"}
        print(os.getpid(), claim_device(found, locks=Path(sys.argv[1])), found["CUDA_VISIBLE_DEVICES"], flush=True)
        while True:
            signal.pause()
for worker in workers:
    os.kill(worker, signal.SIGKILL)
"""


def test_the_environment_comes_before_the_driver(tmp_path):
    for k in range(3):
        (tmp_path / f"0000:{k}").mkdir()
    assert devices_of({}, tmp_path) == ["0", "1", "2"]
    assert devices_of({VISIBLE: "2, GPU-8f"}, tmp_path) == ["2", "GPU-8f"]
    assert devices_of({VISIBLE: ""}, tmp_path) == [] and devices_of({}, tmp_path / "none") == []
    one = {VISIBLE: "1"}
    assert claim_device(one, locks=tmp_path) is None and one == {VISIBLE: "1"}


@pytest.mark.slow
def test_workers_take_different_gpus_and_a_dead_one_gives_its_own_back(tmp_path):
    """Three processes have three GPUs; a fourth shares one; after a kill its GPU is free again."""

    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "env": environment}
    with subprocess.Popen([sys.executable, "-c", CODE, str(tmp_path)], **pipes) as parent:

        def answer(line=""):
            parent.stdin.write(line + "\n")
            parent.stdin.flush()
            return parent.stdout.readline().split()

        def start():
            worker, device, visible = answer()
            assert device == visible
            return worker, device

        workers = [start() for _ in range(3)]
        assert [device for _, device in workers] == ["0", "1", "GPU-8f"]
        assert len({worker for worker, _ in workers}) == 3
        assert start()[1] in ("0", "1", "GPU-8f")
        assert answer(workers[1][0]) == ["gone"]
        assert start()[1] == "1"
    assert parent.returncode == 0


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
