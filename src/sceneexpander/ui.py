"""``python -m sceneexpander.ui``: MLflow's interface over the local store, on loopback only; running adaptations show live."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys

from sceneexpander.errors import UserError, entry_point
from sceneexpander.project import LIVE_FOLDER, find_project
from sceneexpander.tracking.config import TrackingConfig
from sceneexpander.tracking.describe import experiment_links
from sceneexpander.tracking.follow import Follower
from sceneexpander.tracking.store import database_path, last_experiment, quiet_environment, tracking_uri


@entry_point
def main() -> None:
    """Start the server and print links that open the numbers, the charts and the pictures."""
    parser = argparse.ArgumentParser(prog="python -m sceneexpander.ui", description=__doc__)
    parser.add_argument("--port", type=int, default=5000)
    port = parser.parse_args().port
    root = find_project()
    if not database_path(root).is_file():
        Follower(root / LIVE_FOLDER, root, TrackingConfig()).poll()  # the first run of all may still be under way
    if not database_path(root).is_file():
        raise UserError("does not exist yet", where=database_path(root), fix="run `make repro` first")
    quiet_environment()
    # The landing page is about something else.
    for name, link in experiment_links(f"http://127.0.0.1:{port}", last_experiment(root)).items():
        print(f"{name + ':':9} {link}", flush=True)
    command = [sys.executable, "-m", "mlflow", "ui", "--host", "127.0.0.1", "--port", str(port)]
    command += ["--backend-store-uri", tracking_uri(TrackingConfig(), root)]
    follower = subprocess.Popen([sys.executable, "-m", "sceneexpander.follow"], cwd=root)
    try:
        raise SystemExit(subprocess.call(command, cwd=root, env=dict(os.environ)))
    except KeyboardInterrupt:
        raise SystemExit(0) from None
    finally:
        follower.terminate()


if __name__ == "__main__":
    main()
