use serde::Deserialize;

/// Ratio of a fine-tuning's rays to the initial field's, as in the named protocols of
/// `experiments/common.yaml`.
const FINE_TUNING_RAY_FACTOR: f64 = 0.5;

/// Parameters that determine the number of a training's rays. Deserialised from the parameters of
/// `train-ss`.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
pub struct RayBudget {
    /// Given number of rays, which overrides the other fields.
    pub rays: Option<u64>,
    /// Rays for each LR pixel of all views.
    pub rays_per_pixel: f64,
    /// Ratio of the rays per LR pixel of an opaque scene to those of other scenes.
    pub opaque_ray_factor: f64,
    /// Minimum number of rays, which a fine-tuning halves.
    pub min_rays: u64,
    /// Maximum number of rays; overrides a larger minimum. A fine-tuning halves it.
    pub max_rays: u64,
}

impl RayBudget {
    /// Returns the number of rays of a training on views with `lr_pixels` in all.
    ///
    /// ```
    /// let budget = workload::RayBudget {
    ///     rays: None,
    ///     rays_per_pixel: 10.0,
    ///     opaque_ray_factor: 0.6,
    ///     min_rays: 50,
    ///     max_rays: 900,
    /// };
    /// assert_eq!(budget.total(30, false, false), 300);
    /// assert_eq!(budget.total(30, true, true), 90);
    /// ```
    pub fn total(&self, lr_pixels: u64, is_opaque: bool, is_fine_tuning: bool) -> u64 {
        if let Some(rays) = self.rays {
            return rays;
        }
        let opaque = if is_opaque { self.opaque_ray_factor } else { 1.0 };
        let rays = opaque * self.rays_per_pixel * lr_pixels as f64;
        let rays = rays.max(self.min_rays as f64).min(self.max_rays as f64);
        let part = if is_fine_tuning { FINE_TUNING_RAY_FACTOR } else { 1.0 };
        (part * rays).round().max(1.0) as u64
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    const LIMITED: RayBudget = RayBudget {
        rays: None,
        rays_per_pixel: 1.0,
        opaque_ray_factor: 0.6,
        min_rays: 100,
        max_rays: 1000,
    };

    /// Unless given, the number of rays follows from the number of LR pixels, within limits.
    #[test]
    fn rays_follow_from_the_pixels() {
        for (rays, rays_per_pixel, is_opaque, is_fine_tuning, expected) in [
            (None, 20.0, false, false, 500),
            (None, 4.5, false, false, 113),
            (None, 20.0, true, false, 300),
            (None, 20.0, false, true, 250),
            (None, 0.5, false, false, 100),
            (None, 0.5, false, true, 50),
            (None, 60.0, false, false, 1000),
            (None, 60.0, false, true, 500),
            (Some(7), 20.0, false, false, 7),
            (Some(7000), 20.0, true, true, 7000),
        ] {
            let budget = RayBudget { rays, rays_per_pixel, ..LIMITED };
            assert_eq!(budget.total(25, is_opaque, is_fine_tuning), expected, "{budget:?}");
        }
        let minimal = RayBudget { rays_per_pixel: 0.1, min_rays: 0, max_rays: 9, ..LIMITED };
        assert_eq!(minimal.total(0, false, false), 1);
    }

    /// Other parameters of the stage are ignored.
    #[test]
    fn a_budget_is_read_from_a_stages_parameters() {
        let parameters = json!({
            "rays": null, "rays_per_pixel": 2, "opaque_ray_factor": 0.6, "min_rays": 100,
            "max_rays": 1000, "seed": 1
        });
        let expected = RayBudget { rays_per_pixel: 2.0, ..LIMITED };
        assert_eq!(serde_json::from_value::<RayBudget>(parameters).unwrap(), expected);
        assert!(serde_json::from_value::<RayBudget>(json!({"rays": null})).is_err());
    }
}
