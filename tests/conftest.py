"""Property tests judge results, never speed: the machine may be busy with anything."""

from hypothesis import HealthCheck, settings

settings.register_profile("twostage-servo", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("twostage-servo")
