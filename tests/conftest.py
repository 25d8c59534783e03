"""What all tests share."""

import os

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")  # as the command does, and before numpy is imported

# Hundreds of processes are started, and each of them would compile all of zfusion where it must not keep the outcome.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
