"""The trainer: few annotated images to an ONNX model bundle."""
