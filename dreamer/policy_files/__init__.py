"""The policy file of a trained agent, and its ONNX network."""
