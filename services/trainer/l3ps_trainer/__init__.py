"""The trainer: few annotated images to an ONNX model bundle."""

import l3ps.segment  # noqa: F401  (before onnxruntime is imported: it switches that package's telemetry off)
