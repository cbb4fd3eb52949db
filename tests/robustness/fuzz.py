"""Damage files and read them, many times over: ``fuzz.py SUBJECT:FIRST:LAST …`` prints one JSON line a try.

A try ends well (``fine``) or in one clear error (``refused``); ``broke`` is another exception. Whoever runs this takes
a try that is not reported in time for a hang, and one that ends the process for a crash.
"""

import json
import resource
import shutil
import sys
import tempfile
import traceback
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from mutations import mutate
from subjects import SUBJECTS, files_of, quiet

from hesim_render.core.errors import HesimError


def attempt(name, folder, seed):
    """Damage one file, read, put it right again."""
    read = SUBJECTS[name][1]
    files = files_of(name, folder)
    file = files[seed % len(files)]
    whole = file.read_bytes()
    file.write_bytes(mutate(file.name, whole, seed))
    told = {"seed": seed, "file": str(file.relative_to(folder))}
    try:
        with quiet(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            read(folder)
        return told | {"end": "fine"}
    except HesimError as error:
        text = str(error)
        return told | {"end": "refused" if text.strip() and len(text) < 2000 else "broke", "error": text[:300]}
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)
        ours = next((f"{f.filename}:{f.lineno}" for f in reversed(where) if "hesim_render/" in f.filename), "")
        return told | {"end": "broke", "error": f"{type(error).__name__}: {str(error)[:200]}", "where": ours}
    finally:
        file.write_bytes(whole)


def main(name, first, last):
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    try:
        SUBJECTS[name][0](folder)
        with quiet():
            SUBJECTS[name][1](folder)  # what is not damaged is read
        for seed in range(first, last):
            print(json.dumps({"subject": name} | attempt(name, folder, seed)), flush=True)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    for part in sys.argv[1:]:
        subject, begin, end = part.split(":")
        main(subject, int(begin), int(end))
    print(json.dumps({"end": "done", "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}), flush=True)
