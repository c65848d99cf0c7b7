use std::f64::consts::TAU;

use glam::{DMat3, DVec3};

use crate::material::Material;

/// Shape in its own space.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Shape {
    /// Ball: radius.
    Ball(f64),
    /// Box: half sides.
    Block(DVec3),
    /// Upright cylinder: radius, half height.
    Drum(f64, f64),
    /// Rod with round ends: end points, radius.
    Rod(DVec3, DVec3, f64),
}

/// Shape with a pose and a material.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Object {
    pub(crate) shape: Shape,
    pub(crate) centre: DVec3,
    /// Rotation from world axes to the object's own axes.
    pub(crate) to_local: DMat3,
    pub(crate) material: Material,
}

impl Object {
    /// Creates an object whose axes are the world's.
    fn new(shape: Shape, centre: DVec3, material: Material) -> Self {
        Self { shape, centre, to_local: DMat3::IDENTITY, material }
    }

    /// Returns distance and normal of the first surface that a ray hits; the normal is in the
    /// object's own space.
    fn intersect(&self, origin: DVec3, direction: DVec3) -> Option<(f64, DVec3)> {
        let local_origin = self.to_local * (origin - self.centre);
        self.shape.intersect(local_origin, self.to_local * direction)
    }

    /// Returns the bounding ball in the world.
    fn bounding_ball(&self) -> BoundingBall {
        let (centre, radius) = self.shape.bounding_ball();
        BoundingBall { centre: self.centre + self.to_local.transpose() * centre, radius }
    }
}

/// Ball around objects, so that one test suffices for most rays that miss them.
#[derive(Clone, Copy, Debug)]
struct BoundingBall {
    centre: DVec3,
    radius: f64,
}

/// Objects inside one bounding ball, each also inside its own.
#[derive(Clone, Debug)]
struct Cluster {
    ball: BoundingBall,
    objects: Vec<Object>,
    /// Bounding ball of each object.
    balls: Vec<BoundingBall>,
}

/// Intersection of a ray with a surface.
pub(crate) struct Hit {
    /// Distance along the ray.
    pub(crate) t: f64,
    /// Unit normal in world space.
    pub(crate) normal: DVec3,
    /// Point in the object's own space, coordinates of textures: about -1 to 1, except on
    /// rods.
    pub(crate) local: DVec3,
    /// Normal in the object's own space.
    pub(crate) local_normal: DVec3,
    pub(crate) material: Material,
}

/// Scene of objects on a round base, inside a ball of radius 1.35 around the origin; a backdrop
/// reaches farther.
#[derive(Clone, Debug)]
pub struct World {
    clusters: Vec<Cluster>,
    pub(crate) seed: u32,
    /// True if rays that hit nothing end in a sky.
    pub(crate) has_sky: bool,
}

/// Height of the base's top.
const FLOOR: f64 = -0.5;

impl World {
    /// Creates the scene of a seed: the seed rotates the arrangement, permutes the objects'
    /// positions and changes textures.
    pub fn new(seed: u32) -> Self {
        let turn = f64::from(seed % 360) * 2.4;
        let foot = |slot: u32, distance: f64| {
            let angle = turn + f64::from((slot * (1 + seed % 4) + seed) % 5) * TAU / 5.0;
            distance * horizontal_direction(angle) + DVec3::Z * FLOOR
        };
        let ball_centre = foot(1, 0.62) + DVec3::Z * 0.3;
        let mut clusters = vec![
            base(),
            printed_crate(foot(0, 0.62), 0.5 + turn),
            Cluster::new(vec![Object::new(Shape::Ball(0.3), ball_centre, Material::RedVeined)]),
            cage(foot(2, 0.64)),
        ];
        clusters.extend(spring(foot(3, 0.60)));
        clusters.push(sign(foot(4, 0.66)));
        Self { clusters, seed, has_sky: false }
    }

    /// Adds an unbounded background: ground, distant towers, and sky.
    #[must_use]
    pub fn with_backdrop(mut self) -> Self {
        let ground = FLOOR - 0.2;
        let disc = Shape::Drum(60.0, 0.05);
        let disc = Object::new(disc, DVec3::Z * (ground - 0.05), Material::Tiles);
        self.clusters.push(Cluster::new(vec![disc]));
        for k in 0..9u32 {
            // Scattered by the golden angle, between 7 and 20 units away.
            let angle = f64::from(k + self.seed % 9) * 2.4;
            let distance = 7.0 + 1.6 * f64::from(k);
            let half = DVec3::new(0.7, 0.9, 1.2 + 0.35 * f64::from(k % 4));
            let foot = distance * horizontal_direction(angle) + DVec3::Z * ground;
            let centre = foot + DVec3::Z * half.z;
            let tower = Object::new(Shape::Block(half), centre, Material::Crate);
            self.clusters.push(Cluster::new(vec![tower]));
        }
        self.has_sky = true;
        self
    }

    /// Returns the distance from a point to the nearest surface, below 0 inside objects: ground
    /// truth for geometry that is reconstructed from the scene's images.
    pub fn distance(&self, point: DVec3) -> f64 {
        let mut distance = f64::INFINITY;
        for object in self.clusters.iter().flat_map(|cluster| &cluster.objects) {
            let local = object.to_local * (point - object.centre);
            distance = distance.min(object.shape.distance(local));
        }
        distance
    }

    /// Returns point and outward unit normal of the first surface that a ray hits. The direction
    /// has unit length.
    pub fn surface(&self, origin: DVec3, direction: DVec3) -> Option<(DVec3, DVec3)> {
        self.first_hit(origin, direction).map(|hit| (origin + hit.t * direction, hit.normal))
    }

    /// Returns the first intersection of a ray, beyond a tiny distance.
    pub(crate) fn first_hit(&self, origin: DVec3, direction: DVec3) -> Option<Hit> {
        let mut first: Option<(f64, &Object, DVec3)> = None;
        for object in self.candidates(origin, direction) {
            if let Some((t, normal)) = object.intersect(origin, direction)
                && first.as_ref().is_none_or(|(nearest, ..)| t < *nearest)
            {
                first = Some((t, object, normal));
            }
        }
        first.map(|(t, object, local_normal)| {
            let scale = object.shape.texture_scale();
            Hit {
                t,
                normal: object.to_local.transpose() * local_normal,
                local: object.to_local * (origin + t * direction - object.centre) / scale,
                local_normal,
                material: object.material,
            }
        })
    }

    /// Returns whether a ray hits any surface, beyond a tiny distance.
    pub(crate) fn is_hit(&self, origin: DVec3, direction: DVec3) -> bool {
        self.candidates(origin, direction)
            .any(|object| object.intersect(origin, direction).is_some())
    }

    /// Returns the objects whose bounding balls a ray hits.
    fn candidates(&self, origin: DVec3, direction: DVec3) -> impl Iterator<Item = &Object> {
        let clusters = self.clusters.iter();
        clusters
            .filter(move |cluster| cluster.ball.is_hit(origin, direction))
            .flat_map(|cluster| cluster.objects.iter().zip(&cluster.balls))
            .filter(move |(_, ball)| ball.is_hit(origin, direction))
            .map(|(object, _)| object)
    }
}

/// Returns the horizontal direction at an angle, of unit length.
fn horizontal_direction(angle: f64) -> DVec3 {
    DVec3::new(libm::cos(angle), libm::sin(angle), 0.0)
}

/// Returns the rotation from world axes to those of an object rotated around the vertical.
fn vertical_rotation(angle: f64) -> DMat3 {
    DMat3::from_cols(
        DVec3::new(libm::cos(angle), -libm::sin(angle), 0.0),
        DVec3::new(libm::sin(angle), libm::cos(angle), 0.0),
        DVec3::Z,
    )
}

/// Creates the round base.
fn base() -> Cluster {
    let centre = DVec3::new(0.0, 0.0, FLOOR - 0.06);
    Cluster::new(vec![Object::new(Shape::Drum(1.1, 0.06), centre, Material::Tiles)])
}

/// Creates the printed crate.
fn printed_crate(foot: DVec3, angle: f64) -> Cluster {
    let half = 0.26;
    let block =
        Object::new(Shape::Block(DVec3::splat(half)), foot + DVec3::Z * half, Material::Crate);
    Cluster::new(vec![Object { to_local: vertical_rotation(angle), ..block }])
}

/// Creates the cage of rods with a striped ball inside.
fn cage(foot: DVec3) -> Cluster {
    let ball = Object::new(Shape::Ball(0.17), foot + DVec3::Z * 0.36, Material::Stripes);
    let mut objects = vec![ball];
    let on_circle = |k: usize, n: usize| 0.27 * horizontal_direction(k as f64 / n as f64 * TAU);
    for k in 0..12 {
        let p = on_circle(k, 12);
        objects.push(Object::new(
            Shape::Rod(p, p + DVec3::Z * 0.7, 0.011),
            foot,
            Material::DarkMetal,
        ));
    }
    for height in [0.02, 0.36, 0.7] {
        for k in 0..20 {
            let [a, b] = [k, k + 1].map(|k| on_circle(k, 20) + DVec3::Z * height);
            objects.push(Object::new(Shape::Rod(a, b, 0.013), foot, Material::DarkMetal));
        }
    }
    Cluster::new(objects)
}

/// Creates the copper spring, in clusters short enough for tight bounding balls.
fn spring(foot: DVec3) -> Vec<Cluster> {
    const PIECES: usize = 80;
    let rods: Vec<Object> = (0..PIECES)
        .map(|k| {
            let [a, b] = [k, k + 1].map(|k| spring_point(k as f64 / PIECES as f64));
            Object::new(Shape::Rod(a, b, 0.018), foot, Material::Copper)
        })
        .collect();
    rods.chunks(16).map(|rods| Cluster::new(rods.to_vec())).collect()
}

/// Returns the point of the spring's wire at a fraction of its length.
fn spring_point(fraction: f64) -> DVec3 {
    const TURNS: f64 = 5.0;
    let radius = 0.20 - 0.08 * fraction;
    radius * horizontal_direction(fraction * TURNS * TAU) + DVec3::Z * (0.02 + 0.95 * fraction)
}

/// Creates the sign on a thin post.
fn sign(foot: DVec3) -> Cluster {
    let facing = libm::atan2(foot.y, foot.x) + std::f64::consts::FRAC_PI_2;
    let post =
        Object::new(Shape::Rod(DVec3::ZERO, DVec3::Z * 0.5, 0.014), foot, Material::DarkMetal);
    let board = Shape::Block(DVec3::new(0.27, 0.010, 0.19));
    let board = Object::new(board, foot + DVec3::Z * 0.62, Material::Sign);
    Cluster::new(vec![post, Object { to_local: vertical_rotation(facing), ..board }])
}

impl Cluster {
    /// Creates a cluster with its bounding balls.
    fn new(objects: Vec<Object>) -> Self {
        let mut balls: Vec<BoundingBall> = objects.iter().map(Object::bounding_ball).collect();
        let centre = balls.iter().map(|ball| ball.centre).sum::<DVec3>() / balls.len() as f64;
        let mut radius = 0.0f64;
        for ball in &mut balls {
            radius = radius.max((ball.centre - centre).length() + ball.radius);
            // An object's ball is enlarged, so that rounding loses no hit. The cluster's ball may
            // lose hits at its border; a larger one would change published images.
            ball.radius += MAX_ROUNDING_ERROR;
        }
        Self { ball: BoundingBall { centre, radius }, objects, balls }
    }
}

impl BoundingBall {
    /// Returns whether a ray hits the ball.
    fn is_hit(&self, origin: DVec3, direction: DVec3) -> bool {
        let to_centre = self.centre - origin;
        let along = to_centre.dot(direction);
        let squared_distance = to_centre.length_squared() - along * along;
        let r2 = self.radius * self.radius;
        squared_distance < r2 && (along > 0.0 || to_centre.length_squared() < r2)
    }
}

/// Upper bound of rounding errors of distances in the scene; chosen by hand.
const MAX_ROUNDING_ERROR: f64 = 1e-6;
/// Minimum distance of an intersection; nearer ones are of the surface that the ray starts on.
/// Chosen by hand.
const MIN_DISTANCE: f64 = 1e-6;

/// Solves a·t² + 2·b·t + c = 0.
fn solve_quadratic(a: f64, b: f64, c: f64) -> Option<(f64, f64)> {
    let discriminant = b * b - a * c;
    let root = discriminant.sqrt();
    (discriminant >= 0.0 && a > 0.0).then(|| ((-b - root) / a, (-b + root) / a))
}

impl Shape {
    /// Returns the lengths along each axis by which texture coordinates are divided: half of the
    /// shape's size, but along z a drum's radius. Rods have no texture.
    fn texture_scale(self) -> DVec3 {
        match self {
            Self::Ball(r) => DVec3::splat(r),
            Self::Block(half) => half,
            Self::Drum(r, _) => DVec3::splat(r),
            Self::Rod(..) => DVec3::ONE,
        }
    }

    /// Returns centre and radius of the bounding ball in the shape's own space.
    fn bounding_ball(self) -> (DVec3, f64) {
        match self {
            Self::Ball(r) => (DVec3::ZERO, r),
            Self::Block(half) => (DVec3::ZERO, half.length()),
            Self::Drum(r, h) => (DVec3::ZERO, (r * r + h * h).sqrt()),
            Self::Rod(a, b, r) => (0.5 * (a + b), 0.5 * (b - a).length() + r),
        }
    }

    /// Returns the distance of a point from the surface, below 0 inside, in the shape's own space.
    fn distance(self, p: DVec3) -> f64 {
        match self {
            Self::Ball(r) => p.length() - r,
            Self::Block(half) => box_distance(p.abs() - half),
            Self::Drum(r, h) => {
                let radial = libm::sqrt(p.x * p.x + p.y * p.y) - r;
                // A box in the plane of radius and height.
                box_distance(DVec3::new(radial, p.z.abs() - h, f64::NEG_INFINITY))
            }
            Self::Rod(a, b, r) => {
                let (axis, from) = (b - a, p - a);
                let along = (from.dot(axis) / axis.length_squared()).clamp(0.0, 1.0);
                (from - along * axis).length() - r
            }
        }
    }

    /// Returns distance and normal of a ray's first intersection, in the shape's own space.
    fn intersect(self, o: DVec3, d: DVec3) -> Option<(f64, DVec3)> {
        match self {
            Self::Ball(r) => intersect_ball(r, o, d),
            Self::Block(half) => intersect_block(half, o, d),
            Self::Drum(r, h) => intersect_drum(r, h, o, d),
            Self::Rod(a, b, r) => intersect_rod([a, b], r, o, d),
        }
    }
}

/// Returns the signed distance from a box, given the signed distances from its faces along each
/// axis.
fn box_distance(face_distances: DVec3) -> f64 {
    face_distances.max(DVec3::ZERO).length() + face_distances.max_element().min(0.0)
}

fn intersect_ball(r: f64, o: DVec3, d: DVec3) -> Option<(f64, DVec3)> {
    let (near, far) = solve_quadratic(d.length_squared(), o.dot(d), o.length_squared() - r * r)?;
    let t = if near > MIN_DISTANCE { near } else { far };
    (t > MIN_DISTANCE).then(|| (t, (o + t * d) / r))
}

fn intersect_block(half: DVec3, o: DVec3, d: DVec3) -> Option<(f64, DVec3)> {
    let inverse = d.recip();
    let (a, b) = ((-half - o) * inverse, (half - o) * inverse);
    let (low, high) = (a.min(b), a.max(b));
    let (near, far) = (low.max_element(), high.min_element());
    let t = if near > MIN_DISTANCE { near } else { far };
    if near > far || t <= MIN_DISTANCE {
        return None;
    }
    let p = (o + t * d) / half;
    let axis = if p.x.abs() >= p.y.abs().max(p.z.abs()) {
        DVec3::X
    } else if p.y.abs() >= p.z.abs() {
        DVec3::Y
    } else {
        DVec3::Z
    };
    Some((t, axis * p.dot(axis).signum()))
}

fn intersect_drum(r: f64, h: f64, o: DVec3, d: DVec3) -> Option<(f64, DVec3)> {
    let mut nearest = Nearest::default();
    let roots = solve_quadratic(
        d.x * d.x + d.y * d.y,
        o.x * d.x + o.y * d.y,
        o.x * o.x + o.y * o.y - r * r,
    );
    for t in roots.into_iter().flat_map(|(near, far)| [near, far]) {
        let p = o + t * d;
        if p.z.abs() <= h {
            nearest.update(t, DVec3::new(p.x / r, p.y / r, 0.0));
        }
    }
    for side in [-1.0, 1.0] {
        let t = (side * h - o.z) / d.z;
        let p = o + t * d;
        if t.is_finite() && p.x * p.x + p.y * p.y <= r * r {
            nearest.update(t, DVec3::Z * side);
        }
    }
    nearest.0
}

fn intersect_rod([a, b]: [DVec3; 2], r: f64, o: DVec3, d: DVec3) -> Option<(f64, DVec3)> {
    let axis = b - a;
    let (length2, od) = (axis.length_squared(), o - a);
    let (along_d, along_o) = (axis.dot(d), axis.dot(od));
    let mut nearest = Nearest::default();
    let roots = solve_quadratic(
        length2 * d.length_squared() - along_d * along_d,
        length2 * od.dot(d) - along_o * along_d,
        length2 * (od.length_squared() - r * r) - along_o * along_o,
    );
    for t in roots.into_iter().flat_map(|(near, far)| [near, far]) {
        let along = (along_o + t * along_d) / length2;
        if (0.0..=1.0).contains(&along) {
            nearest.update(t, (od + t * d - along * axis) / r);
        }
    }
    for end in [a, b] {
        if let Some((t, normal)) = intersect_ball(r, o - end, d) {
            nearest.update(t, normal);
        }
    }
    nearest.0
}

/// Nearest intersection so far: distance and normal.
#[derive(Default)]
struct Nearest(Option<(f64, DVec3)>);

impl Nearest {
    /// Takes an intersection if it is nearer.
    fn update(&mut self, t: f64, normal: DVec3) {
        if t > MIN_DISTANCE && self.0.is_none_or(|(nearest, _)| t < nearest) {
            self.0 = Some((t, normal));
        }
    }
}
