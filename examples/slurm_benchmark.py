"""Build a benchmark on a SLURM cluster::

    python examples/slurm_benchmark.py benchmark.yaml OUT --partition compute --jobs 20

dask-jobqueue (`pip install 'distributed>=2024.8' dask-jobqueue`) sends jobs to SLURM. Each starts workers, which
connect to a scheduler in this process. Stopping this script, or the end of a job's time, loses no finished clip: run it
again. OUT must lie on a file system that all nodes see.
"""

import argparse


def cluster_of(partition, minutes, memory, cores=1, gpus=0):
    """A cluster whose jobs have one worker of one thread for each core, or for each GPU where there are some."""
    from dask_jobqueue import SLURMCluster

    processes = gpus or cores
    return SLURMCluster(
        queue=partition, walltime=f"{minutes // 60:02d}:{minutes % 60:02d}:00", memory=memory, cores=processes,
        processes=processes, job_extra_directives=[f"--gres=gpu:{gpus}"] if gpus else [],
        # workers of a job that ends are replaced; leave them time to end their clip first
        worker_extra_args=["--lifetime", f"{max(1, minutes - 10)}m", "--lifetime-stagger", "5m"],
    )  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("spec")
    parser.add_argument("out")
    parser.add_argument("--partition", required=True)
    parser.add_argument("--jobs", type=int, default=10)
    parser.add_argument("--minutes", type=int, default=240)
    parser.add_argument("--memory", default="4GB")
    parser.add_argument("--cores", type=int, default=1)
    parser.add_argument("--gpus", type=int, default=0)
    given = parser.parse_args()
    from hesim_render.benchmark import build_benchmark

    with cluster_of(given.partition, given.minutes, given.memory, given.cores, given.gpus) as cluster:
        cluster.scale(jobs=given.jobs)
        built = build_benchmark(given.spec, given.out, scheduler=cluster.scheduler_address)
    print(f"{len(built.manifest['clips'])} clips in {built.root}")


if __name__ == "__main__":
    main()
