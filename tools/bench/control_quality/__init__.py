"""How well the project's laws and honest baselines move axes that are off their model."""
