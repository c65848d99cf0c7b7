use radiance::{Field, PointSample, spec::VIEW_FEATURES};

/// What a volume is baked from. Places lie in the unit cube.
pub(crate) trait Source: Sync {
    /// Whether there may be something between two corners.
    fn may_hold(&self, low: [f32; 3], high: [f32; 3]) -> bool;
    /// What there is at some places.
    fn sample(&self, places: &[[f32; 3]]) -> Vec<PointSample>;
    /// What is added to raw colours for view features, seen along each of some directions.
    fn view_colours(
        &self,
        features: &[f32; VIEW_FEATURES],
        directions: &[[f32; 3]],
    ) -> Vec<[f32; 3]>;
}

impl Source for Field {
    fn may_hold(&self, low: [f32; 3], high: [f32; 3]) -> bool {
        Self::may_hold(self, low, high)
    }

    fn sample(&self, places: &[[f32; 3]]) -> Vec<PointSample> {
        self.sample_points(places)
    }

    fn view_colours(
        &self,
        features: &[f32; VIEW_FEATURES],
        directions: &[[f32; 3]],
    ) -> Vec<[f32; 3]> {
        Self::view_colours(self, features, directions)
    }
}
