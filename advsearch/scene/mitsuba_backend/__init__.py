"""The one place with Mitsuba's names: variant, libLLVM, dictionary, plugins, scene,
denoiser.
"""
