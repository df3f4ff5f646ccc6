"""The agent: recurrent model, world model, actor and critic, optimiser."""
