use pixels::Picture;
use radiance::{Draws, Ray, Supervision};
use scene::{Background, Views};

/// The paper's supervision: a training pixel is drawn at random, s×s sub-rays are cast through it, and the mean of their
/// colours is compared with it (mean squared error over the three channels).
pub struct Average {
    views: Vec<TrainingView>,
    pixels: u64,
    background: Background,
    supersample: u32,
    jitter: bool,
    seed: u64,
}

struct TrainingView {
    picture: Picture,
    /// Number of pixels in the views before this one.
    before: u64,
    origin: [f32; 3],
    /// Direction of image position (0, 0), and what one pixel to the right or down adds; not of unit length.
    corner: [f64; 3],
    right: [f64; 3],
    down: [f64; 3],
}

/// Purposes of draws.
const PIXEL: u64 = 100;
const BACKGROUND: u64 = 101;
const JITTER: u64 = 102;

impl Average {
    /// Supervision by pictures that match the views: RGB over the background, or premultiplied RGBA where that is open.
    pub fn new(views: &Views, pictures: Vec<Picture>, supersample: u32, jitter: bool, seed: u64) -> Self {
        let mut pixels = 0;
        let views_ready = views.views.iter().zip(pictures).map(|(view, picture)| {
            let before = pixels;
            pixels += (picture.width * picture.height) as u64;
            let (k, r) = (view.camera.intrinsics, view.camera.rotation());
            let corner = r * glam::DVec3::new(-k.cx / k.fx, k.cy / k.fy, -1.0);
            TrainingView {
                picture,
                before,
                origin: view.camera.centre().as_vec3().to_array(),
                corner: corner.to_array(),
                right: (r.x_axis / k.fx).to_array(),
                down: (-r.y_axis / k.fy).to_array(),
            }
        });
        let views_ready = views_ready.collect();
        Self { views: views_ready, pixels, background: views.background, supersample, jitter, seed }
    }

    /// The view and pixel that a group trains on.
    fn pixel(&self, group: u64) -> (&TrainingView, usize) {
        let at = Draws::new(self.seed, PIXEL, group).below(self.pixels);
        let view = &self.views[self.views.partition_point(|v| v.before <= at) - 1];
        (view, (at - view.before) as usize)
    }

    /// What lies behind a group's rays: with an open background another colour each time, so that opacity is learnt.
    fn behind(&self, group: u64) -> [f32; 3] {
        if self.background == Background::Alpha {
            let mut draws = Draws::new(self.seed, BACKGROUND, group);
            [0, 1, 2].map(|_| draws.uniform())
        } else {
            [self.background.shown(); 3]
        }
    }
}

impl Supervision for Average {
    fn rays_per_group(&self) -> usize {
        (self.supersample * self.supersample) as usize
    }

    fn cast(&self, group: u64, rays: &mut [Ray]) {
        let (view, pixel) = self.pixel(group);
        let background = self.behind(group);
        let (x, y) = (pixel % view.picture.width, pixel / view.picture.width);
        let mut draws = Draws::new(self.seed, JITTER, group);
        let s = f64::from(self.supersample);
        for (k, ray) in rays.iter_mut().enumerate() {
            let mut offset = || if self.jitter { f64::from(draws.uniform()) } else { 0.5 };
            let (a, b) = (k % self.supersample as usize, k / self.supersample as usize);
            let u = x as f64 + (a as f64 + offset()) / s;
            let v = y as f64 + (b as f64 + offset()) / s;
            let d: [f64; 3] = std::array::from_fn(|i| view.corner[i] + u * view.right[i] + v * view.down[i]);
            let length = d.iter().map(|x| x * x).sum::<f64>().sqrt();
            *ray = Ray { origin: view.origin, direction: d.map(|x| (x / length) as f32), background };
        }
    }

    fn judge(&self, group: u64, colours: &[[f32; 3]], gradients: &mut [[f32; 3]]) -> f64 {
        let (view, pixel) = self.pixel(group);
        let picture = &view.picture;
        let sample = &picture.data[pixel * picture.channels..][..picture.channels];
        let share = 1.0 / colours.len() as f32;
        let behind = if picture.channels == 4 { self.behind(group) } else { [0.0; 3] };
        let mut loss = 0.0;
        for c in 0..3 {
            let target = if picture.channels == 4 { sample[c] + (1.0 - sample[3]) * behind[c] } else { sample[c] };
            let mean = colours.iter().map(|colour| colour[c]).sum::<f32>() * share;
            let residual = mean - target;
            loss += f64::from(residual) * f64::from(residual) / 3.0;
            for gradient in gradients.iter_mut() {
                gradient[c] = residual * share * (2.0 / 3.0);
            }
        }
        loss
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use scene::{Bounds, Camera, Intrinsics, View};

    fn example(supersample: u32) -> (Average, Camera) {
        let camera = Camera {
            name: "a".into(),
            intrinsics: Intrinsics { width: 5, height: 4, fx: 6.0, fy: 7.0, cx: 2.4, cy: 2.1 },
            camera_to_world: [[0., 0., 1., 3.], [1., 0., 0., 0.5], [0., 1., 0., 0.2]],
        };
        let bounds = Bounds { min: [-1.; 3], max: [1.; 3], near: 0.1, far: 9.0 };
        let views = Views::new(Background::White, bounds, vec![View::camera_only(camera.clone())]);
        let picture = Picture::new(5, 4, 3, (0..60).map(|i| i as f32 / 60.0).collect());
        (Average::new(&views, vec![picture], supersample, false, 9), camera)
    }

    /// The sub-rays of a pixel are the pixels of the finer image: no half-pixel shift.
    #[test]
    fn sub_rays_are_the_finer_cameras_pixel_rays() {
        let (average, camera) = example(3);
        let fine = camera.resized(15, 12);
        let mut rays = [Ray::default(); 9];
        for group in 0..50 {
            average.cast(group, &mut rays);
            let (_, pixel) = average.pixel(group);
            for (k, ray) in rays.iter().enumerate() {
                let (i, j) = (pixel % 5 * 3 + k % 3, pixel / 5 * 3 + k / 3);
                let expected = fine.ray(i as f64 + 0.5, j as f64 + 0.5).direction.as_vec3().to_array();
                assert!((0..3).all(|c| (ray.direction[c] - expected[c]).abs() < 1e-6));
            }
        }
    }

    #[test]
    fn gradient_is_that_of_the_loss() {
        let (average, _) = example(2);
        let colours: Vec<[f32; 3]> = (0..4).map(|k| [0.1 * k as f32, 0.5, 0.9]).collect();
        let mut gradients = vec![[0.0; 3]; 4];
        average.judge(7, &colours, &mut gradients);
        for k in 0..4 {
            for c in 0..3 {
                let mut moved = colours.clone();
                let mut scrap = vec![[0.0; 3]; 4];
                moved[k][c] += 0.01;
                let up = average.judge(7, &moved, &mut scrap);
                moved[k][c] -= 0.02;
                let numeric = (up - average.judge(7, &moved, &mut scrap)) / 0.02;
                assert!((f64::from(gradients[k][c]) - numeric).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn every_pixel_is_drawn() {
        let (average, _) = example(1);
        let mut seen = [false; 20];
        (0..400).for_each(|g| seen[average.pixel(g).1] = true);
        assert!(seen.iter().all(|s| *s));
    }
}
