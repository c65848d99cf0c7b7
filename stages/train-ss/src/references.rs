use pixels::{Exposure, Filter, Picture, Resampling, psnr_of};

use crate::Photographs;

/// A reference that was shrunk is its own LR photograph, up to rounding, or shows something else where it differs by more than this, in dB.
const ALIKE: f64 = 25.0;

/// References as they should join a training: of one with an LR photograph of its own the exposure is that photograph's, and it is left out where it
/// shows something else. What was done is said. `filter` made the LR photographs.
pub(crate) fn checked(
    mut references: Photographs,
    photographs: &Photographs,
    filter: Filter,
    say: &dyn Fn(String),
) -> Photographs {
    let own = |camera: &scene::Camera| -> Option<&Picture> {
        let view = photographs.views.taken_by(camera)?;
        let place = photographs.views.views.iter().position(|other| std::ptr::eq(other, view))?;
        Some(&photographs.pictures[place].picture)
    };
    let pairs = references.views.views.into_iter().zip(references.pictures);
    let kept = pairs.filter_map(|(view, mut photograph)| {
        let Some(own) = own(&view.camera) else { return Some((view, photograph)) };
        let (name, reference) = (&view.camera.name, &mut photograph.picture);
        let shrink = Resampling::new(filter, (reference.width, reference.height), (own.width, own.height));
        let mut shrunk = shrink.apply(reference);
        if let Some(exposure) = Exposure::between(own, &shrunk, 1).filter(|exposure| !exposure.is_none()) {
            let [r, g, b] = exposure.gain;
            say(format!("reference {name} has another exposure ({r:.2}, {g:.2}, {b:.2} times as bright): taken back"));
            exposure.take_back(reference);
            exposure.take_back(&mut shrunk);
        }
        let colours = |picture: &Picture| -> Vec<f32> {
            picture.data.chunks_exact(picture.channels).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect()
        };
        let (shrunk, own) = (colours(&shrunk), colours(own));
        let error = shrunk.iter().zip(&own).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>() / own.len() as f64;
        let alike = psnr_of(error);
        if alike < ALIKE {
            say(format!("reference {name} looks otherwise than its own LR photograph ({alike:.1} dB) and is left out: another view, or something that moved?"));
        }
        (alike >= ALIKE).then_some((view, photograph))
    });
    (references.views.views, references.pictures) = kept.unzip();
    references
}

#[cfg(test)]
mod tests {
    use scene::{Background, Bounds, Camera, Intrinsics, View, Views};

    use super::*;

    /// Patches with fine stripes, as seen from there.
    fn photographs(name: &str, picture: Picture) -> Photographs {
        let (width, height) = (picture.width as u32, picture.height as u32);
        let intrinsics = Intrinsics { width, height, fx: 20.0, fy: 20.0, cx: 8.0, cy: 8.0, distortion: Default::default() };
        let camera_to_world = [[0., 0., 1., 3.], [1., 0., 0., 0.5], [0., 1., 0., 0.2]];
        let camera = Camera { name: name.into(), intrinsics, camera_to_world };
        let views = Views::new(Background::White, Bounds::default(), vec![View::camera_only(camera)]);
        Photographs { views, pictures: vec![picture.into()] }
    }

    fn fine() -> Picture {
        let sample = |i: usize| {
            let (x, y, c) = (i / 3 % 32, i / 96, i % 3);
            0.2 + 0.5 * radiance::uniform(3, c as u64, (x / 8 * 9 + y / 8) as u64) + if (x + y) % 4 < 2 { 0.05 } else { -0.05 }
        };
        Picture::new(32, 32, 3, (0..32 * 32 * 3).map(sample).collect())
    }

    #[test]
    fn exposures_are_taken_back_and_other_pictures_are_left_out() {
        let low = || photographs("a", Resampling::new(Filter::Lanczos, (32, 32), (16, 16)).apply(&fine()));
        let checked = |name: &str, change: &dyn Fn(f32) -> f32| {
            let said = std::cell::RefCell::new(String::new());
            let mut picture = fine();
            picture.data.iter_mut().for_each(|v| *v = change(*v));
            let kept = checked(photographs(name, picture), &low(), Filter::Lanczos, &|text| said.borrow_mut().push_str(&text));
            (kept.pictures.into_iter().next().map(|p| p.picture), kept.views.views.len(), said.into_inner())
        };
        let (same, views, said) = checked("a", &|v| v);
        assert!(same.unwrap().data == fine().data && views == 1 && said.is_empty(), "{said}");
        let (dark, views, said) = checked("a", &|v| 0.6 * v + 0.1);
        let off = dark.unwrap().data.iter().zip(&fine().data).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(off < 0.01 && views == 1 && said.contains("another exposure (0.60, 0.60, 0.60"), "{off} {said}");
        let (other, views, said) = checked("a", &|v| 1.0 - v);
        assert!(other.is_none() && views == 0 && said.contains("left out"), "{said}");
        // Nothing is known of a view that has no LR photograph.
        let (unknown, _, said) = checked("b", &|v| 1.0 - v);
        assert!(unknown.is_some() && said.is_empty(), "{said}");
    }
}
