"""What is minimised: parameters and their scale, noise, and the residuals of poses and of motion in short bins."""
