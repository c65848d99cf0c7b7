//! Finds the files that a data set names inside its folder, even if the folder was written on
//! another machine, or its files were moved, renamed, converted or reduced (docs/design/005).
//!
//! A name is tried:
//!
//! * literally;
//! * with `\` read as `/`;
//! * without its leading parts, the same number for all names. Only absolute paths lose parts, or
//!   all paths if no name is found otherwise;
//! * in a reduced copy `images_N`, if `images` is missing or empty;
//! * with a missing, doubled or converted extension;
//! * in a different Unicode normal form (NFC, or NFD as on macOS);
//! * in a different case.
//!
//! Steps combine, each logs one line per data set ([`Lookup::notes`]), and two candidates are an
//! error. Paths out of the folder are never opened; links inside it are followed.

mod listings;
mod matching;
mod steps;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use artifact::{PathError, relative_path};

use crate::file_status::{FileProblem, check_file, path_text};
use crate::photograph::is_image_name;
use crate::unsupported::is_unsupported_name;

pub(crate) use listings::Listings;
use matching::{Extensions, Tolerance, absolute_parts, candidates, inside_parts};
use steps::{Step, Steps};

/// Folder of photographs in most formats; reduced copies are in `images_2`, `images_4` and so on.
const IMAGES: &str = "images";

/// Error returned when a name doesn't determine a single file inside the folder.
#[derive(Debug, thiserror::Error)]
pub(crate) enum LookupError {
    /// Path out of the folder, or an empty name.
    #[error(
        "{0}; name a file in the folder, or move the list of names to the folder above, and give \
        that folder"
    )]
    Path(#[from] PathError),
    /// Name of no file, or of something that can't be read as a file.
    #[error("{0}; restore or rename the file, or remove its entry")]
    File(#[from] FileProblem),
    /// Name that two files match equally well; both paths are relative to the data set's folder.
    #[error(
        "{} and {} both match {name:?}; remove one of the two, or name it exactly",
        path_text(first),
        path_text(second)
    )]
    Ambiguous { name: String, first: PathBuf, second: PathBuf },
}

impl LookupError {
    /// True if no file has the name.
    pub(crate) fn is_missing(&self) -> bool {
        matches!(self, Self::File(FileProblem::Missing(_)))
    }
}

/// File found for a name. Both paths are relative to the data set's folder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct LocatedFile {
    pub(crate) path: PathBuf,
    /// Path that names the view: without the second of two extensions.
    pub(crate) label: PathBuf,
}

impl From<PathBuf> for LocatedFile {
    fn from(path: PathBuf) -> Self {
        Self { label: path.clone(), path }
    }
}

/// Treatment of files that other names match literally.
#[derive(Clone, Copy, PartialEq, Eq)]
enum ClaimedFiles {
    /// Claimed files are not found by tolerance.
    Excluded,
    /// Claimed files are also found by tolerance.
    Included,
}

/// Function that splits a name whose leading parts may be removed; `None` for other names.
type SplitName = fn(&str) -> Option<Vec<&str>>;

/// Interpretation of a name as a path.
struct Interpretation {
    path: PathBuf,
    /// Steps that lead to the path.
    steps: Vec<Step>,
}

impl Interpretation {
    fn extensions(&self) -> Extensions {
        let is_copy = self.steps.contains(&Step::Substitute);
        if is_copy { Extensions::Any } else { Extensions::Similar }
    }
}

/// Lookup of a data set's names.
pub(crate) struct Lookup {
    listings: Listings,
    /// Folder that names are relative to, inside the data set's folder.
    base: PathBuf,
    /// Function that splits names whose leading parts may be removed.
    split_name: SplitName,
    /// Number of leading parts that such names lose; `None` if no tail is a file.
    removed: Option<usize>,
    /// Folder `images_N` that is read instead of a missing `images`.
    substitute: Option<String>,
    /// True if names without an extension mean PNG files, as in NeRF's synthetic scenes.
    is_png_implied: bool,
    /// Files that names match literally, which no other name may match by tolerance.
    claimed: BTreeSet<PathBuf>,
    steps: Steps,
}

impl Lookup {
    /// Creates the lookup of names relative to the data set's folder. `names` are those of images,
    /// masks and depth images, `repeated` those that split lists repeat.
    pub(crate) fn in_folder(folder: &Path, names: &[&str], repeated: &[&str]) -> Self {
        let mut lookup = Self::new(folder, PathBuf::new(), names);
        lookup.is_png_implied = true;
        let names = [names, repeated].concat();
        if !lookup.choose_removed_and_substitute(&names, absolute_parts) {
            lookup.choose_removed_and_substitute(&names, inside_parts);
        }
        lookup
    }

    /// Creates the lookup of names relative to `images` or a reduced copy of it or, if none is
    /// found there, to the data set's folder.
    pub(crate) fn in_images(folder: &Path, names: &[&str]) -> Self {
        let mut inside = Self::new(folder, PathBuf::from(IMAGES), names);
        let mut outside = Self::new(folder, PathBuf::new(), names);
        for split_name in [absolute_parts as SplitName, inside_parts] {
            if inside.choose_removed_and_substitute(names, split_name) {
                return inside;
            }
            if outside.choose_removed_and_substitute(names, split_name) {
                return outside;
            }
        }
        if inside.listings.is_folder(Path::new(IMAGES)) { inside } else { outside }
    }

    fn new(folder: &Path, base: PathBuf, names: &[&str]) -> Self {
        let literal = names.iter().filter_map(|name| relative_path(name).ok());
        let claimed = literal.map(|path| base.join(path)).collect();
        Self {
            listings: Listings::new(folder),
            base,
            split_name: absolute_parts,
            removed: None,
            substitute: None,
            is_png_implied: false,
            claimed,
            steps: Steps::default(),
        }
    }

    /// Returns the data set's folder.
    pub(crate) fn root(&self) -> &Path {
        self.listings.root()
    }

    /// Returns the folder that names are relative to.
    pub(crate) fn base(&self) -> PathBuf {
        if self.base.as_os_str().is_empty() {
            return self.root().to_path_buf();
        }
        self.root().join(&self.base)
    }

    /// Returns a path of the data set relative to the folder that names are relative to, or to its
    /// reduced copy.
    pub(crate) fn without_base(&self, path: &Path) -> PathBuf {
        let images = self.substitute.as_deref().unwrap_or(IMAGES);
        let inside = path.strip_prefix(&self.base).or_else(|_| path.strip_prefix(images));
        inside.unwrap_or(path).to_path_buf()
    }

    /// Returns a note for each step that found names.
    pub(crate) fn notes(&self) -> Vec<String> {
        self.steps.notes(self.removed, self.substitute.as_deref())
    }

    /// Finds the file of a name, and records the steps that led there.
    pub(crate) fn find(&mut self, name: &str) -> Result<LocatedFile, LookupError> {
        self.locate(name, ClaimedFiles::Excluded)
    }

    /// Finds the file of a name that a list repeats. Unlike [`Self::find`], also finds claimed
    /// files by tolerance.
    pub(crate) fn find_repeated(&mut self, name: &str) -> Result<LocatedFile, LookupError> {
        self.locate(name, ClaimedFiles::Included)
    }

    fn locate(&mut self, name: &str, claimed: ClaimedFiles) -> Result<LocatedFile, LookupError> {
        let literal = self.literal_path(name);
        let mut missing = None;
        if let Ok(path) = &literal {
            match check_file(&self.root().join(path), "an image") {
                Ok(()) if is_image_name(Path::new(name)) => return Ok(path.clone().into()),
                Ok(()) => {}
                Err(problem @ FileProblem::Missing(_)) => missing = Some(problem),
                Err(problem) => return Err(problem.into()),
            }
        }
        if let Some((file, steps)) = self.search(name, claimed)? {
            self.steps.record(name, &file.path, steps);
            return Ok(file);
        }
        if let Some(path) = self.unsupported_file(name) {
            return Ok(path.into());
        }
        match (missing, literal) {
            (Some(problem), _) => Err(problem.into()),
            (None, Err(error)) if absolute_parts(name).is_none() => Err(error.into()),
            _ => Err(LookupError::File(FileProblem::Missing(format!(
                "no file in the data set matches the end of the absolute path {}",
                path_text(Path::new(name))
            )))),
        }
    }

    /// Finds the image in an unsupported format that a name without extension means. Reading that
    /// image fails with an error that names the command to convert it.
    fn unsupported_file(&mut self, name: &str) -> Option<PathBuf> {
        let path = self.base.join(relative_path(name).ok()?);
        let stem = path.file_name().filter(|_| !has_image_extension(&path))?;
        let folder = path.parent()?;
        let names = self.listings.names(folder);
        let mut files = names.iter().map(|name| folder.join(name));
        files.find(|file| file.file_stem() == Some(stem) && is_unsupported_name(file))
    }

    /// Returns the path of a name taken literally, with an implied `.png`.
    fn literal_path(&self, name: &str) -> Result<PathBuf, PathError> {
        let mut path = self.base.join(relative_path(name)?);
        if self.is_png_implied && !has_image_extension(&path) && !self.listings.is_file(&path) {
            // `set_extension` would cut a name like `r.0`.
            path.as_mut_os_string().push(".png");
        }
        Ok(path)
    }

    /// Finds the single file that matches a name, and the steps that lead there.
    fn search(
        &mut self,
        name: &str,
        claimed: ClaimedFiles,
    ) -> Result<Option<(LocatedFile, Vec<Step>)>, LookupError> {
        let interpretations = self.interpretations(name);
        for tolerance in Tolerance::STEPS {
            for interpretation in &interpretations {
                match &self.matches(interpretation, tolerance, claimed)[..] {
                    [] => {}
                    [file] => return Ok(Some(self.located(interpretation, tolerance, file))),
                    [first, second, ..] => {
                        return Err(LookupError::Ambiguous {
                            name: name.to_owned(),
                            first: first.clone(),
                            second: second.clone(),
                        });
                    }
                }
            }
        }
        Ok(None)
    }

    /// Returns the interpretations of a name, the most literal first.
    fn interpretations(&self, name: &str) -> Vec<Interpretation> {
        let mut paths = vec![(relative_path(name), Vec::new())];
        if name.contains('\\') {
            paths.push((relative_path(&name.replace('\\', "/")), vec![Step::Slashes]));
        }
        if let (Some(parts), Some(removed)) = ((self.split_name)(name), self.removed) {
            let tail = parts[removed.min(parts.len())..].join("/");
            paths.push((relative_path(&tail), vec![Step::Tail]));
        }
        let mut found = Vec::new();
        for (path, mut steps) in paths {
            let Ok(path) = path else { continue };
            let mut path = self.base.join(path);
            if let (Some(substitute), Ok(inside)) = (&self.substitute, path.strip_prefix(IMAGES)) {
                path = Path::new(substitute).join(inside);
                steps.push(Step::Substitute);
            }
            found.push(Interpretation { path, steps });
        }
        found
    }

    fn matches(
        &mut self,
        interpretation: &Interpretation,
        tolerance: Tolerance,
        claimed: ClaimedFiles,
    ) -> Vec<PathBuf> {
        let (path, extensions) = (&interpretation.path, interpretation.extensions());
        let mut files = candidates(&mut self.listings, path, tolerance, extensions);
        // A converted copy of an unsupported file is preferred to the file itself.
        if tolerance == Tolerance::NONE && !files.is_empty() && is_unsupported_name(path) {
            let converted = Tolerance { extension: true, ..tolerance };
            let found = candidates(&mut self.listings, path, converted, extensions);
            files = if found.is_empty() { files } else { found };
        }
        if tolerance != Tolerance::NONE && claimed == ClaimedFiles::Excluded {
            files.retain(|file| !self.claimed.contains(file));
        }
        files
    }

    /// Returns the file of an interpretation with the label of its view, and the steps that led
    /// there.
    fn located(
        &self,
        interpretation: &Interpretation,
        tolerance: Tolerance,
        file: &Path,
    ) -> (LocatedFile, Vec<Step>) {
        let path = &interpretation.path;
        let shorter = file.with_extension("");
        let is_implied = self.is_png_implied
            && !has_image_extension(path)
            && shorter == *path
            && file.extension().is_some_and(|extension| extension == "png");
        let is_exact = !tolerance.form && !tolerance.case;
        let is_renamed = tolerance.extension || is_exact && file != path;
        let is_similar = interpretation.extensions() == Extensions::Similar;
        let extension = is_renamed && !is_implied && is_similar;
        let is_doubled = extension && is_image_name(path) && is_image_name(&shorter);
        let label = if is_doubled { shorter } else { file.to_path_buf() };
        let mut steps = interpretation.steps.clone();
        for (is_taken, step) in [
            (extension, Step::Extension),
            (tolerance.form, Step::Form),
            (tolerance.case, Step::Case),
        ] {
            steps.extend(is_taken.then_some(step));
        }
        (LocatedFile { path: file.to_path_buf(), label }, steps)
    }

    /// Chooses the number of parts to remove from names and the substitute for a missing `images`,
    /// so that most names are found. Longer tails and larger copies are preferred. Returns whether
    /// at least one name is found.
    fn choose_removed_and_substitute(&mut self, names: &[&str], split_name: SplitName) -> bool {
        self.split_name = split_name;
        let longest = names.iter().filter_map(|name| split_name(name)).map(|p| p.len()).max();
        let removals: Vec<Option<usize>> = match longest {
            Some(parts) => (0..parts).map(Some).collect(),
            None => vec![None],
        };
        let substitutes = self.substitutes();
        if longest.is_none() && substitutes.len() == 1 {
            // Nothing to choose.
            return names.iter().any(|name| self.has_file(name));
        }
        let mut best = (0, None, None);
        for removed in &removals {
            for substitute in &substitutes {
                self.removed = *removed;
                self.substitute.clone_from(substitute);
                let count = names.iter().filter(|name| self.has_file(name)).count();
                if count > best.0 {
                    best = (count, *removed, substitute.clone());
                }
                if best.0 == names.len() {
                    return best.0 > 0;
                }
            }
        }
        (_, self.removed, self.substitute) = best;
        best.0 > 0
    }

    /// Returns the possible substitutes of `images`, the largest photographs first: none and, if
    /// `images` is missing or empty, its reduced copies.
    fn substitutes(&mut self) -> Vec<Option<String>> {
        let mut found = vec![None];
        let root = Path::new("");
        let variants = self.listings.variants(root, IMAGES);
        if variants.iter().any(|name| !self.listings.names(Path::new(name)).is_empty()) {
            return found;
        }
        found.extend(reduced_copies(&mut self.listings).into_iter().map(Some));
        found
    }

    /// True if at least one file matches a name.
    fn has_file(&mut self, name: &str) -> bool {
        !matches!(self.search(name, ClaimedFiles::Included), Ok(None))
    }
}

/// Returns the folders `images_N` of a data set, sorted by N.
pub(crate) fn reduced_copies(listings: &mut Listings) -> Vec<String> {
    let root = Path::new("");
    let mut copies: Vec<(u32, String)> = Vec::new();
    for name in listings.names(root) {
        let factor = name.strip_prefix("images_").and_then(|factor| factor.parse().ok());
        if let Some(factor) = factor.filter(|_| listings.is_folder(Path::new(&name))) {
            copies.push((factor, name));
        }
    }
    copies.sort();
    copies.into_iter().map(|(_, name)| name).collect()
}

/// True if a name has the extension of an image, supported or not.
fn has_image_extension(path: &Path) -> bool {
    is_image_name(path) || is_unsupported_name(path)
}

#[cfg(test)]
mod tests;
