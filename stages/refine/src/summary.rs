use artifact::format_count;
use refinement::ReferenceStatistics;

/// Statistics of a run for its summary.
pub(crate) struct Summary {
    /// Number of views.
    pub(crate) views: usize,
    /// Number of views made consistent with their own LR photographs.
    pub(crate) consistent: usize,
    /// Number of views averaged with their enlarged photographs.
    pub(crate) averaged: usize,
    /// Fraction of the predicted residual that was added.
    pub(crate) residual_weight: f32,
    /// True if the network reports statistics of references.
    pub(crate) has_reference_statistics: bool,
    /// Statistics of each reference, summed over the views.
    pub(crate) statistics: Vec<ReferenceStatistics>,
}

impl Summary {
    /// Returns the summary as one sentence.
    pub(crate) fn text(&self) -> String {
        let mut text = format!(
            "{}{}, residual weight {:.2}",
            format_count(self.views, "view"),
            self.references(),
            self.residual_weight
        );
        if self.averaged > 0 {
            text += &format!("; {} averaged with enlarged photographs", self.averaged);
        }
        if self.consistent > 0 {
            text += &format!("; {} consistent with LR photographs", self.consistent);
        }
        text
    }

    /// Describes the number of references and the mean confidence in them.
    fn references(&self) -> String {
        if self.statistics.is_empty() {
            return String::new();
        }
        let references = format_count(self.statistics.len(), "reference");
        if !self.has_reference_statistics {
            return format!(" with {references}");
        }
        let mut all = ReferenceStatistics::default();
        for reference in &self.statistics {
            all.add(reference);
        }
        if all.visible_pixels == 0 {
            return format!(" with {references} (visible in no view)");
        }
        format!(" with {references} (confidence {:.0} %)", 100.0 * all.confidence_share())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_summary_describes_the_refinement() {
        let plain = Summary {
            views: 1,
            consistent: 0,
            averaged: 0,
            residual_weight: 0.8,
            has_reference_statistics: false,
            statistics: Vec::new(),
        };
        assert_eq!(plain.text(), "1 view, residual weight 0.80");
        let visible = ReferenceStatistics { visible_pixels: 10, visibility: 8.0, confidence: 4.0 };
        let by_references = Summary {
            views: 3,
            consistent: 2,
            averaged: 1,
            has_reference_statistics: true,
            statistics: vec![visible, ReferenceStatistics::default()],
            ..plain
        };
        assert_eq!(
            by_references.text(),
            "3 views with 2 references (confidence 50 %), residual weight 0.80; 1 averaged with \
             enlarged photographs; 2 consistent with LR photographs"
        );
        let hidden = Summary { statistics: vec![ReferenceStatistics::default()], ..by_references };
        assert!(hidden.text().starts_with("3 views with 1 reference (visible in no view), "));
    }
}
