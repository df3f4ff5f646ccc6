"""What a policy reads: images, scans, odometry, and whether frames are fresh."""
