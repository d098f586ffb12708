"""What the API carries along by importing the platform: nothing that only the method needs."""

import subprocess
import sys

HEAVY = ("onnxruntime", "kiss_icp", "cv2", "scipy", "hdbscan", "l3ps_cluster", "pypatchworkpp", "torch", "sklearn")


def test_the_platform_needs_none_of_the_method_s_libraries() -> None:
    modules = "catalog, objects, workflow, queue, metrics, telemetry, settings, errors"
    script = f"import sys; from l3ps_platform import {modules}; print(sorted(set(sys.modules) & set({HEAVY!r})))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_celery_comes_only_with_the_queue() -> None:
    """It takes a third of a second, which commands that only look something up need not wait for."""
    script = "import sys; from l3ps_platform import catalog, objects, workflow, metrics; print('celery' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
