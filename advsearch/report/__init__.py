"""Pages and pictures about runs, made from what a run left behind. Never imports torch
or mitsuba.
"""
