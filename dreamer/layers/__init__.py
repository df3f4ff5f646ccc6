"""Parts of networks: layers, convolutions, distributions, encoders and decoders."""
