"""Poses of an event camera in a map of lines that is there already.

`PoseTracker` takes events as they come and tells a pose for each interval: followed from the one
before (`fit`), or found near a rough guess (`locate`), which borrows the front end of `mapping`.
"""
