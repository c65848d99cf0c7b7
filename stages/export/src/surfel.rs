use glam::DVec3;
use rayon::prelude::*;
use scene::Bounds;

use crate::seen::SeenView;

/// A piece of a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Surfel {
    /// Middle in scene units, in the frame of the exported files.
    pub(crate) position: DVec3,
    /// Unit normal, towards the cameras that see it.
    pub(crate) normal: DVec3,
    /// Pixels from its middle to the nearest silhouette, in the view where that is most.
    pub(crate) margin: u8,
    /// Display-encoded sRGB, the mean over the views that see it.
    pub(crate) colour: [f32; 3],
    /// Mean opacity of the pixels that show it.
    pub(crate) opacity: f32,
    /// Distance to its neighbours, about, in scene units.
    pub(crate) spacing: f64,
}

/// A pixel that shows a surface: the cell of its point, then view and pixel, which order them.
type Sample = ([u32; 3], u32, u32);
/// Maximum bytes per pixel that [`merge`] needs: a sample, twice while samples are collected.
pub(crate) const BYTES_PER_PIXEL: u64 = 2 * size_of::<Sample>() as u64;

/// Merges what all views see: one surfel for each cell of a grid over the field's unit cube. The
/// cells are as large as half of the views' pixels, or larger where there would be more than
/// `most`. The surfels are in the order of their cells.
pub(crate) fn merge(views: &[SeenView], bounds: &Bounds, most: usize) -> Vec<Surfel> {
    let mut edge = finest_edge(views, bounds);
    loop {
        let samples = samples(views, bounds, edge);
        let groups: Vec<&[Sample]> = samples.chunk_by(|a, b| a.0 == b.0).collect();
        if groups.len() <= most {
            let surfel = |group: &&[Sample]| surfel(views, bounds, edge, group);
            return groups.par_iter().filter_map(surfel).collect();
        }
        // A surface's cells go with the square of their edge.
        edge *= (groups.len() as f64 / most as f64).sqrt() * 1.01;
    }
}

/// Half of the median of all pixels' widths, in cube sides.
fn finest_edge(views: &[SeenView], bounds: &Bounds) -> f64 {
    let mut widths: Vec<f64> = views
        .par_iter()
        .flat_map_iter(|view| {
            view.surface().map(|(at, _)| view.footprint(at) * per_unit(view, bounds, at))
        })
        .filter(|width| width.is_finite() && *width > 0.0)
        .collect();
    widths.par_sort_unstable_by(f64::total_cmp);
    widths.get(widths.len() / 2).map_or(1.0, |width| 0.5 * width).max(1e-6)
}

/// Cube sides for each scene unit, at a pixel's point.
fn per_unit(view: &SeenView, bounds: &Bounds, at: usize) -> f64 {
    let (point, width) = (view.world_point(at), view.footprint(at));
    (bounds.to_cube(point + width * view.right()) - bounds.to_cube(point)).length() / width
}

/// All pixels that show a surface inside the cube, sorted.
fn samples(views: &[SeenView], bounds: &Bounds, edge: f64) -> Vec<Sample> {
    let mut samples: Vec<Sample> = views
        .par_iter()
        .enumerate()
        .flat_map_iter(|(number, view)| {
            view.surface().filter_map(move |(at, _)| {
                let place = bounds.to_cube(view.world_point(at));
                let is_inside = place.cmpge(DVec3::ZERO).all() && place.cmple(DVec3::ONE).all();
                let cell = (place / edge).to_array().map(|x| x as u32);
                is_inside.then_some((cell, number as u32, at as u32))
            })
        })
        .collect();
    samples.par_sort_unstable();
    samples
}

/// The mean of a cell's pixels: those count more that see the surface from near and not aslant.
fn surfel(views: &[SeenView], bounds: &Bounds, edge: f64, group: &[Sample]) -> Option<Surfel> {
    // Up to where a surface goes is known to a pixel: a cell of silhouettes alone is dropped.
    let margins = group.iter().map(|&(_, view, at)| views[view as usize].pixel(at as usize).margin);
    let margin = margins.max().filter(|margin| *margin > 0)?;
    let (mut position, mut normal, mut colour) = (DVec3::ZERO, DVec3::ZERO, DVec3::ZERO);
    let (mut opacity, mut footprint, mut cell, mut weights) = (0.0, 0.0, 0.0, 0.0);
    for &(_, number, at) in group {
        let (view, at) = (&views[number as usize], at as usize);
        let pixel = view.pixel(at);
        let width = view.footprint(at);
        let weight = f64::from(view.cosine(at)).max(0.05).powi(2) / (width * width);
        position += weight * view.world_point(at);
        normal += weight * view.world_normal(at);
        colour += weight * DVec3::from(pixel.colour.map(f64::from));
        opacity += weight * f64::from(pixel.opacity);
        footprint += weight * width;
        cell += weight * edge / per_unit(view, bounds, at);
        weights += weight;
    }
    // Both sides of a thin thing may share a cell.
    let normal = normal.try_normalize()?;
    let share = 1.0 / (255.0 * weights);
    Some(Surfel {
        position: position / weights,
        normal,
        margin,
        colour: (colour * share).as_vec3().to_array(),
        opacity: (opacity * share) as f32,
        spacing: (cell / weights).max(footprint / weights / (group.len() as f64).sqrt()),
    })
}
