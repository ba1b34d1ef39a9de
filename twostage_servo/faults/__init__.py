"""The fault campaign: every fault that an axis must meet, injected into the running service, with what it may cost."""
