"""One thin file per pipeline stage: read the declared sections and artefacts, call the library once, save."""

import os

import sceneexpander  # noqa: F401 - first of all: it says what an interrupt does while the rest is imported

# Read when the libraries are loaded, so set before any is. A thread that has nothing to do sleeps: on a machine that other work keeps
# busy, threads that wait for each other by spinning cost more CPU time than the work itself. numpy's matrices here are small, and
# OpenCV's pictures, too: what is worth two threads there (dense matching) has its own.
for _name, _value in (("OMP_WAIT_POLICY", "PASSIVE"), ("OPENBLAS_NUM_THREADS", "1"), ("OPENCV_FOR_THREADS_NUM", "1")):
    os.environ.setdefault(_name, _value)
