"""Everything that knows Mitsuba: variant, libLLVM, plugins, scene, denoiser."""
