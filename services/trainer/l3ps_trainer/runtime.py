"""ONNX Runtime as the trainer runs it."""

from __future__ import annotations

from pathlib import Path

import onnxruntime


def session_of(path: Path, threads: int) -> onnxruntime.InferenceSession:
    """A session on the CPU that sleeps when idle."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
