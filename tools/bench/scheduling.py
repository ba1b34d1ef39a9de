"""The scheduling class that a process asks for."""

import os


def run_at(priority: int) -> bool:
    """Let this process run under SCHED_FIFO at a priority, 0 for the ordinary class; return whether it may."""
    if priority == 0:
        return True
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        return False
    return True


def may_run_at(priority: int) -> bool:
    """Return whether processes may have this priority; this one goes on as it was."""
    policy, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    permitted = run_at(priority)
    os.sched_setscheduler(0, policy, parameter)
    return permitted
