"""Damage files and read them, many times over: ``fuzz.py SUBJECT:FIRST:LAST …`` prints one JSON line a try.

``SUBJECT/places`` puts something else in the place of each file: a pipe, a device, a folder, six GB that are not there.

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
from places import LONG, PLACES, put, put_back
from subjects import SUBJECTS, files_of, quiet

from hesim_render.core.errors import HesimError


def attempt(name, folder, seed, files, in_place=False):
    """Damage one file, read, put it right again."""
    read = SUBJECTS[name][1]
    file, kind = files[seed // len(PLACES) if in_place else seed % len(files)], PLACES[seed % len(PLACES)]
    whole = file.read_bytes()
    if in_place:
        put(kind, file)
    else:
        file.write_bytes(mutate(file.name, whole, seed))
    told = {"seed": seed, "file": str(file.relative_to(folder)), **({"kind": kind} if in_place else {})}
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
        put_back(file, whole)


def main(name, first, last):
    name, _, places = name.partition("/")
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    try:
        SUBJECTS[name][0](folder)
        with quiet():
            SUBJECTS[name][1](folder)  # what is not damaged is read
        files = files_of(name, folder)
        last = min(last, len(files) * len(PLACES)) if places else last
        for seed in range(first, last):
            if places and name in LONG and PLACES[seed % len(PLACES)] == "large":
                continue
            print(json.dumps({"subject": name} | attempt(name, folder, seed, files, bool(places))), flush=True)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    for part in sys.argv[1:]:
        subject, begin, end = part.split(":")
        main(subject, int(begin), int(end))
    print(json.dumps({"end": "done", "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}), flush=True)
