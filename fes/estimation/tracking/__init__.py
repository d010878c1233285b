"""What the trackers of feet and shanks share: taking samples in, and the last twenty seconds of them."""
