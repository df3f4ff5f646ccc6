"""Policy files as functions of JAX, the world that they were trained in, and how surprised they are."""
