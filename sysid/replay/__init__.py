"""Open-loop replay of logs by a vehicle or by a model of your own, batched over trials and parameter sets."""
