//! Finds the files that a data set names, inside its folder, as people's folders have them: written
//! on another machine, moved, renamed, converted or reduced.
//!
//! A name is tried literally; with `\` read as `/`; as the longest tail of an absolute path,
//! with equally many leading parts removed for all names; with a missing or doubled extension; and
//! in another case. Steps combine, each logs one line for the data set ([`Lookup::notes`]), and two
//! candidates are an error. A name that leads out of the folder is never opened; links inside the
//! folder are followed.

mod listings;
mod matching;
mod steps;
mod written;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use artifact::{PathError, relative_path};

use crate::found::{Found, find};
use crate::misplaced::{Misplaced, shown};
use crate::photograph::is_image_name;
use crate::unread::is_unread_name;

pub(crate) use listings::Listings;
use matching::{Extensions, Tolerance, candidates};
use steps::{Steps, Taken};
use written::absolute_parts;

/// Folder of photographs in most formats. Reduced copies are in `images_2`, `images_4` and so on.
const IMAGES: &str = "images";

/// Error of a name that leads to no single file inside the folder.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LookupError {
    /// The name leads out of the folder, or names nothing.
    #[error(transparent)]
    Path(#[from] PathError),
    /// Two files match the name equally well.
    #[error(
        "{} and {} both match {name:?}; remove one of the two, or name it exactly",
        shown(first),
        shown(second)
    )]
    Ambiguous {
        /// Name in the data set.
        name: String,
        /// First of the files, inside the data set's folder.
        first: PathBuf,
        /// Second of the files.
        second: PathBuf,
    },
}

/// Result of looking a name up.
#[derive(Debug)]
pub(crate) enum Located {
    File(LocatedFile),
    Nothing(Misplaced),
    /// Something that cannot be read as a file.
    Other(Misplaced),
}

/// File of a name. Both paths are relative to the data set's folder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct LocatedFile {
    pub(crate) path: PathBuf,
    /// Path whose stem names the view: without the second of two extensions.
    pub(crate) label: PathBuf,
}

/// Treatment of files that other names mean literally.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Claims {
    /// They are not found by tolerance.
    Respected,
    /// They are found.
    Ignored,
}

/// Path that a name may mean.
struct Form {
    path: PathBuf,
    taken: Taken,
    extensions: Extensions,
}

/// Lookup of a data set's names.
pub(crate) struct Lookup {
    listings: Listings,
    /// Folder that relative names start from, inside the data set's.
    base: PathBuf,
    /// Leading parts that absolute names lose; `None` where no tail of them exists.
    removed: Option<usize>,
    /// Folder `images_N` that is read instead of a missing `images`.
    stand_in: Option<String>,
    /// True if names without an extension mean PNG files, as in NeRF's synthetic scenes.
    is_png_implied: bool,
    /// Files that names mean literally, so that no other name can mean them by tolerance.
    claimed: BTreeSet<PathBuf>,
    steps: Steps,
}

impl Lookup {
    /// Looks up names relative to the data set's folder. `names` are those of images, masks and
    /// depth images, `again` those that lists repeat.
    pub(crate) fn in_folder(folder: &Path, names: &[&str], again: &[&str]) -> Self {
        let mut lookup = Self::new(folder, PathBuf::new(), names);
        lookup.is_png_implied = true;
        lookup.settle(&[names, again].concat());
        lookup
    }

    /// Looks up names relative to `images`, to a reduced copy of `images`, or, where none of the
    /// names is found there, to the data set's folder.
    pub(crate) fn in_images(folder: &Path, names: &[&str]) -> Self {
        let mut inside = Self::new(folder, PathBuf::from(IMAGES), names);
        inside.settle(names);
        let mut beside = Self::new(folder, PathBuf::new(), names);
        if names.iter().any(|name| inside.has(name)) {
            return inside;
        }
        beside.settle(names);
        let has_images = inside.listings.is_folder(Path::new(IMAGES));
        if has_images && !names.iter().any(|name| beside.has(name)) { inside } else { beside }
    }

    fn new(folder: &Path, base: PathBuf, names: &[&str]) -> Self {
        let literal = names.iter().filter_map(|name| relative_path(name).ok());
        let claimed = literal.map(|path| base.join(path)).collect();
        Self {
            listings: Listings::new(folder),
            base,
            removed: None,
            stand_in: None,
            is_png_implied: false,
            claimed,
            steps: Steps::default(),
        }
    }

    /// Returns the data set's folder.
    pub(crate) fn root(&self) -> &Path {
        self.listings.root()
    }

    /// Returns the folder that relative names start from.
    pub(crate) fn base(&self) -> PathBuf {
        if self.base.as_os_str().is_empty() {
            return self.root().to_path_buf();
        }
        self.root().join(&self.base)
    }

    /// Returns a path of the data set relative to the folder that names start from.
    pub(crate) fn without_base(&self, path: &Path) -> PathBuf {
        let stand_in = self.stand_in.as_deref().unwrap_or(IMAGES);
        let inside = path.strip_prefix(&self.base).or_else(|_| path.strip_prefix(stand_in));
        inside.unwrap_or(path).to_path_buf()
    }

    /// Returns a line for each step that found names.
    pub(crate) fn notes(&self) -> Vec<String> {
        self.steps.notes(self.removed, self.stand_in.as_deref())
    }

    /// Finds the file of a name, and counts the steps that led there.
    pub(crate) fn find(&mut self, name: &str) -> Result<Located, LookupError> {
        self.locate(name, Claims::Respected)
    }

    /// Finds the file of a name in a list that repeats names: a file that another name means.
    pub(crate) fn find_again(&mut self, name: &str) -> Result<Located, LookupError> {
        self.locate(name, Claims::Ignored)
    }

    fn locate(&mut self, name: &str, claims: Claims) -> Result<Located, LookupError> {
        let expected = self.expected(name);
        let mut missing = None;
        if let Ok(path) = &expected {
            match find(&self.root().join(path), "an image") {
                Found::File if is_image_name(Path::new(name)) => {
                    let (path, label) = (path.clone(), path.clone());
                    return Ok(Located::File(LocatedFile { path, label }));
                }
                Found::File => {}
                Found::Nothing(found) => missing = Some(found),
                Found::Other(found) => return Ok(Located::Other(found)),
            }
        }
        if let Some((file, taken)) = self.search(name, claims)? {
            self.steps.record(name, &file.path, taken);
            return Ok(Located::File(file));
        }
        match (missing, expected) {
            (Some(missing), _) => Ok(Located::Nothing(missing)),
            (None, Err(error)) if absolute_parts(name).is_none() => Err(error.into()),
            _ => Ok(Located::Nothing(Misplaced::Elsewhere { path: PathBuf::from(name) })),
        }
    }

    /// Returns the path of a name that is taken literally. NeRF's files leave `.png` out.
    fn expected(&self, name: &str) -> Result<PathBuf, PathError> {
        let mut path = self.base.join(relative_path(name)?);
        if self.is_png_implied && !has_image_extension(&path) && !self.listings.is_file(&path) {
            // `set_extension` would cut a name like `r.0`.
            path.as_mut_os_string().push(".png");
        }
        Ok(path)
    }

    /// Finds the one file that a name means, and the steps that lead there.
    fn search(
        &mut self,
        name: &str,
        claims: Claims,
    ) -> Result<Option<(LocatedFile, Taken)>, LookupError> {
        let forms = self.forms(name);
        for tolerance in Tolerance::STEPS {
            for form in &forms {
                match &self.matches(form, tolerance, claims)[..] {
                    [] => {}
                    [file] => return Ok(Some(self.located(form, tolerance, file))),
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

    /// Returns the paths that a name may mean, the most literal first.
    fn forms(&self, name: &str) -> Vec<Form> {
        let mut forms = Vec::new();
        if let Ok(path) = relative_path(name) {
            forms.push(self.form(&path, Taken::default()));
        }
        if name.contains('\\')
            && let Ok(path) = relative_path(&name.replace('\\', "/"))
        {
            forms.push(self.form(&path, Taken { slashes: true, ..Taken::default() }));
        }
        if let (Some(parts), Some(removed)) = (absolute_parts(name), self.removed)
            && let Ok(path) = relative_path(&parts[removed.min(parts.len())..].join("/"))
        {
            forms.push(self.form(&path, Taken { tail: true, ..Taken::default() }));
        }
        forms
    }

    fn form(&self, path: &Path, taken: Taken) -> Form {
        let path = self.base.join(path);
        match (&self.stand_in, path.strip_prefix(IMAGES)) {
            (Some(stand_in), Ok(inside)) => Form {
                path: Path::new(stand_in).join(inside),
                taken: Taken { stand_in: true, ..taken },
                extensions: Extensions::Any,
            },
            _ => Form { path, taken, extensions: Extensions::Slips },
        }
    }

    fn matches(&mut self, form: &Form, tolerance: Tolerance, claims: Claims) -> Vec<PathBuf> {
        let mut files = candidates(&mut self.listings, &form.path, tolerance, form.extensions);
        if tolerance == Tolerance::NONE && !files.is_empty() && is_unread_name(&form.path) {
            let converted = Tolerance { extension: true, ..tolerance };
            let found = candidates(&mut self.listings, &form.path, converted, form.extensions);
            files = if found.is_empty() { files } else { found };
        }
        if tolerance != Tolerance::NONE && claims == Claims::Respected {
            files.retain(|file| !self.claimed.contains(file));
        }
        files
    }

    /// Returns the file of a form with the name of its view, and the steps that led there.
    fn located(&self, form: &Form, tolerance: Tolerance, file: &Path) -> (LocatedFile, Taken) {
        let shorter = file.with_extension("");
        let is_implied = self.is_png_implied
            && !has_image_extension(&form.path)
            && shorter == form.path
            && file.extension().is_some_and(|extension| extension == "png");
        let is_renamed = tolerance.extension || !tolerance.case && file != form.path;
        let extension = is_renamed && !is_implied && form.extensions == Extensions::Slips;
        let is_doubled = extension && is_image_name(&form.path) && is_image_name(&shorter);
        let label = if is_doubled { shorter } else { file.to_path_buf() };
        let taken = Taken { extension, case: tolerance.case, ..form.taken };
        (LocatedFile { path: file.to_path_buf(), label }, taken)
    }

    /// Chooses how many parts absolute names lose, and what stands in for a missing `images`: what
    /// most names are found by. The longest tail and the largest copy go first.
    fn settle(&mut self, names: &[&str]) {
        let longest = names.iter().filter_map(|name| absolute_parts(name)).map(|p| p.len()).max();
        let removals: Vec<Option<usize>> = match longest {
            Some(parts) => (0..parts).map(Some).collect(),
            None => vec![None],
        };
        let stand_ins = self.stand_ins();
        if removals.len() + stand_ins.len() == 2 {
            return;
        }
        let mut best = (0, None, None);
        for removed in &removals {
            for stand_in in &stand_ins {
                (self.removed, self.stand_in) = (*removed, stand_in.clone());
                let count = names.iter().filter(|name| self.has(name)).count();
                if count > best.0 {
                    best = (count, *removed, stand_in.clone());
                }
                if best.0 == names.len() {
                    return;
                }
            }
        }
        (_, self.removed, self.stand_in) = best;
    }

    /// Returns the folders that may be read as `images`, the largest photographs first: where
    /// `images` is missing or empty, its reduced copies.
    fn stand_ins(&mut self) -> Vec<Option<String>> {
        let mut found = vec![None];
        let root = Path::new("");
        let same = self.listings.alike(root, IMAGES);
        if same.iter().any(|name| !self.listings.names(Path::new(name)).is_empty()) {
            return found;
        }
        found.extend(reduced_copies(&mut self.listings).into_iter().map(Some));
        found
    }

    /// True if a name has a file, or several.
    fn has(&mut self, name: &str) -> bool {
        !matches!(self.search(name, Claims::Ignored), Ok(None))
    }
}

/// Returns the folders `images_N` of a data set, by N.
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

/// True if a name says that its file is an image.
fn has_image_extension(path: &Path) -> bool {
    is_image_name(path) || is_unread_name(path)
}

#[cfg(test)]
mod tests;
