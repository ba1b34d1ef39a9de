"""Time: the tick, how early to wake for it, when its commands leave, simulated time, and histograms of times."""
