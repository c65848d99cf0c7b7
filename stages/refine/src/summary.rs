use artifact::counted;
use refinement::Use;

/// How the views of a run were refined.
pub(crate) struct Summary {
    /// Views.
    pub(crate) views: usize,
    /// Views that are consistent with their own LR photographs.
    pub(crate) consistent: usize,
    /// Views that are means with their enlarged photographs.
    pub(crate) means: usize,
    /// Share of the predicted residual that was added.
    pub(crate) residual_weight: f32,
    /// Whether the network says of what use references were.
    pub(crate) is_reference_based: bool,
    /// What each reference was of use for.
    pub(crate) uses: Vec<Use>,
}

impl Summary {
    /// One sentence.
    pub(crate) fn text(&self) -> String {
        let means = match self.means {
            0 => String::new(),
            count => format!("; {count} are means with their enlarged photographs"),
        };
        let consistent = match self.consistent {
            0 => String::new(),
            count => format!("; {count} of them agree with their own photographs"),
        };
        format!(
            "{}{}, with {:.2} of what the network adds{means}{consistent}",
            counted(self.views, "view"),
            self.references(),
            self.residual_weight
        )
    }

    /// By how many references, and how far these were trusted.
    fn references(&self) -> String {
        if self.uses.is_empty() {
            return String::new();
        }
        let references = counted(self.uses.len(), "reference");
        if !self.is_reference_based {
            return format!(" by {references}");
        }
        let mut all = Use::default();
        self.uses.iter().for_each(|of_use| all.add(of_use));
        if all.seen == 0 {
            return format!(" by {references} that see nothing of them");
        }
        format!(" by {references}, trusted by {:.0} %", 100.0 * all.confidence_share())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_summary_says_what_was_used() {
        let plain = Summary {
            views: 1,
            consistent: 0,
            means: 0,
            residual_weight: 0.8,
            is_reference_based: false,
            uses: Vec::new(),
        };
        assert_eq!(plain.text(), "1 view, with 0.80 of what the network adds");
        let seen = Use { seen: 10, visibility: 8.0, confidence: 4.0 };
        let by_references = Summary {
            views: 3,
            consistent: 2,
            means: 1,
            is_reference_based: true,
            uses: vec![seen, Use::default()],
            ..plain
        };
        assert_eq!(
            by_references.text(),
            "3 views by 2 references, trusted by 50 %, with 0.80 of what the network adds; 1 are \
             means with their enlarged photographs; 2 of them agree with their own photographs"
        );
        let unseen = Summary { uses: vec![Use::default()], ..by_references };
        assert!(unseen.text().starts_with("3 views by 1 reference that see nothing of them, "));
    }
}
