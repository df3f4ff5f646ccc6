"""Closing the loop: from the residual of a fit to the effect that the model lacks. Entry point: `sysid.close_loop`."""
