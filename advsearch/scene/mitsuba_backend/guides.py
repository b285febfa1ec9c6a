"""What guides the denoiser where surfaces have cut-outs: the first hit that light does not pass. Mitsuba's `aov` takes
the first one, and the outline of what is cut off would show. Import it only there.
"""

from __future__ import annotations

from typing import Any

from advsearch.scene.mitsuba_backend.variant import mitsuba

mi: Any = mitsuba()

import drjit  # noqa: E402  (needs the variant that is set above)

dr: Any = drjit


class Guides(mi.SamplingIntegrator):  # type: ignore[misc]
    """The integrator `advsearch_guides`: diffuse reflectance and shading normal, three channels each."""

    @dr.syntax  # type: ignore[untyped-decorator]
    def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
        """See `SamplingIntegrator.sample`; light passes through a surface with its probability."""
        going = mi.Bool(active)
        way = mi.Ray3f(ray)
        covered, albedo, normal = mi.Bool(False), mi.Spectrum(0.0), mi.Normal3f(0.0)
        while going:
            hit = scene.ray_intersect(way, going)
            going &= hit.is_valid()
            bsdf = hit.bsdf()
            clear = dr.max(bsdf.eval_null_transmission(hit, going))
            passes = going & (sampler.next_1d(going) < clear)
            seen = going & ~passes
            albedo[seen] = bsdf.eval_diffuse_reflectance(hit, seen)
            normal[seen] = hit.sh_frame.n
            covered |= seen
            way = hit.spawn_ray(way.d)
            going = passes
        return albedo, covered, [*albedo, *normal]

    def aov_names(self) -> list[str]:
        """See `SamplingIntegrator.aov_names`."""
        return [f"{name}.{channel}" for name in ("albedo", "normal") for channel in "XYZ"]


mi.register_integrator("advsearch_guides", Guides)
