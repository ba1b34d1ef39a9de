"""A client of a running service, blocking and asynchronous, in the standard library alone.

``twostage_servo.connect()`` and ``twostage_servo.connect_async()`` are its public face. `protocol` turns requests into
bytes and bytes into answers, and `verbs` says what each verb asks and waits for; neither reads a socket or a clock.
"""
