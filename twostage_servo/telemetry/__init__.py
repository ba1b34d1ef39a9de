"""What is kept of the ticks: the recording in memory, and a file for each trip."""
