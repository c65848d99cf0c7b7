//! Rows of the table: an extreme setup, the expected outcome and its explanation.

use glam::DVec3;
use scene::{Distortion, looking_at};
use serde_json::{Value, json};

use crate::capture::{Capture, Content, DISTANCE, SIZE, forward, pinhole, turn_away};
use crate::trial::{Setup, merge};

/// Outcome that a row must have.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Expected {
    /// PSNR that differs from the baseline's by at most this many dB.
    Like(f64),
    /// Minimum PSNR in dB.
    Psnr(f64),
    /// Success with finite artifacts and any PSNR or none.
    Finite,
    /// Refusal with this exit code and a message that contains this text.
    Refused(i32, &'static str),
}

/// Row of the table.
pub(crate) struct Row {
    pub(crate) part: &'static str,
    pub(crate) case: &'static str,
    pub(crate) expected: Expected,
    /// Explanation of an outcome that differs from the baseline's.
    pub(crate) why: &'static str,
    /// True if CI runs the row.
    pub(crate) fast: bool,
    /// True if the row's note contains the largest parameter and density.
    pub(crate) shows_numbers: bool,
    pub(crate) setup: Setup,
}

/// Builder of a row that changes the baseline.
struct RowBuilder {
    row: Row,
}

/// Creates the builder of a row, with the baseline's setup.
fn row(part: &'static str, case: &'static str) -> RowBuilder {
    RowBuilder {
        row: Row {
            part,
            case,
            expected: Expected::Like(0.15),
            why: "",
            fast: false,
            shows_numbers: false,
            setup: Setup::default(),
        },
    }
}

impl RowBuilder {
    fn capture(mut self, change: impl Fn(&mut Capture)) -> Self {
        change(&mut self.row.setup.capture);
        self
    }

    fn setup(mut self, change: impl Fn(&mut Setup)) -> Self {
        change(&mut self.row.setup);
        self
    }

    fn prep(self, params: &Value) -> Self {
        self.setup(|setup| merge(&mut setup.prep, params))
    }

    fn train(self, params: &Value) -> Self {
        self.setup(|setup| merge(&mut setup.train, params))
    }

    /// Replaces all parameters of `prep`.
    fn replace_prep(self, params: &Value) -> Self {
        self.setup(|setup| setup.prep = params.clone())
    }

    fn fast(mut self) -> Self {
        self.row.fast = true;
        self
    }

    fn numbers(mut self) -> Self {
        self.row.shows_numbers = true;
        self
    }

    fn expect(mut self, expected: Expected, why: &'static str) -> Row {
        (self.row.expected, self.row.why) = (expected, why);
        self.row
    }

    fn like(self, difference: f64) -> Row {
        self.expect(Expected::Like(difference), "")
    }
}

/// Origin in UTM coordinates, in metres.
const UTM: DVec3 = DVec3::new(500_000.1, 4_649_776.2, 120.3);
/// Origin in ECEF coordinates, in metres.
const ECEF: DVec3 = DVec3::new(4_027_893.85, 307_045.825, 4_919_475.175);

/// Returns all rows; the first is the baseline.
pub(crate) fn rows() -> Vec<Row> {
    let groups = [coordinates(), training(), sizes(), lenses(), cameras(), images(), spaces()];
    groups.into_iter().flatten().collect()
}

fn unit(case: &'static str, unit: f64) -> Row {
    row("unit", case).capture(|capture| capture.unit = unit).fast().like(0.15)
}

fn origin(case: &'static str, origin: DVec3) -> RowBuilder {
    row("origin", case).capture(|capture| capture.origin = origin)
}

fn coordinates() -> Vec<Row> {
    use Expected::{Psnr, Refused};
    vec![
        row("baseline", "16 photographs, 48 pixels").fast().numbers().expect(Psnr(15.0), ""),
        row("unit", "1e-160").capture(|c| c.unit = 1e-160).fast().expect(Refused(3, "wide"), ""),
        row("unit", "1e-20").capture(|c| c.unit = 1e-20).fast().expect(Refused(3, "wide"), ""),
        unit("1e-12", 1e-12),
        unit("1e-6", 1e-6),
        unit("1e-3", 1e-3),
        unit("1e3", 1e3),
        unit("1e6", 1e6),
        unit("1e12", 1e12),
        origin("UTM", UTM).fast().like(0.15),
        origin("ECEF", ECEF).fast().like(0.15),
        origin("ECEF, unit 1e-3", ECEF).capture(|capture| capture.unit = 1e-3).like(0.15),
        origin("1e12", DVec3::splat(1e12)).like(0.5),
        origin("1e15", DVec3::splat(1e15)).expect(Psnr(5.0), "centres are rounded"),
        origin("1e17", DVec3::splat(1e17)).expect(Psnr(3.0), "centres are rounded to one"),
        origin("1e19", DVec3::splat(1e19)).fast().expect(Refused(3, "1e18"), ""),
    ]
}

fn rays(case: &'static str, rays: u32) -> RowBuilder {
    row("rays", case).train(&json!({"rays": rays})).numbers()
}

fn rates(case: &'static str, grid: f64, mlps: f64) -> RowBuilder {
    row("learning rates", case)
        .train(&json!({"learning_rate": grid, "mlp_learning_rate": mlps}))
        .numbers()
}

fn training() -> Vec<Row> {
    use Expected::{Like, Psnr};
    vec![
        rays("1", 1).fast().expect(Expected::Refused(2, "one LR pixel needs 4"), ""),
        rays("4", 4).expect(Psnr(3.0), "one step"),
        rays("1 M", 1_000_000).expect(Psnr(20.0), "longer"),
        rays("4 M", 4_000_000).expect(Psnr(20.0), "longer"),
        rates("grid × 10", 0.6, 0.01).expect(Like(5.0), "noisier steps"),
        rates("MLPs × 10", 0.06, 0.1).expect(Like(5.0), "noisier steps"),
        rates("both × 10", 0.6, 0.1).expect(Like(5.0), "noisier steps"),
        rates("both 1", 1.0, 1.0).expect(Psnr(3.0), "noisier steps"),
        rates("both 0", 0.0, 0.0).expect(Psnr(3.0), "untrained"),
        row("tables", "half precision").fast().setup(|setup| setup.half = true).like(0.05),
    ]
}

fn scale(case: &'static str, scale: f64, lr_width: u32) -> RowBuilder {
    row("scale", case).setup(|setup| {
        setup.prep = json!({"lr_width": lr_width, "scale": scale});
        merge(&mut setup.train, &json!({"supersample": scale}));
    })
}

fn views(case: &'static str, views: usize) -> RowBuilder {
    row("views", case).capture(|capture| capture.surround(views, DISTANCE, pinhole(SIZE, 39.6)))
}

fn enlarged(case: &'static str, size: [u32; 2]) -> RowBuilder {
    row("image", case)
        .capture(|capture| capture.enlarged = Some(size))
        .replace_prep(&json!({"lr_source": "photographs", "scale": 1}))
        .train(&json!({"supersample": 1}))
}

fn sizes() -> Vec<Row> {
    use Expected::{Finite, Psnr};
    vec![
        scale("1", 1.0, 48).expect(Psnr(15.0), "four times the pixels"),
        scale("1.1", 1.1, 40).expect(Psnr(15.0), "more pixels"),
        scale("2.7", 2.7, 10).expect(Psnr(15.0), "fewer pixels"),
        scale("16", 16.0, 3).expect(Psnr(5.0), "images of 3 pixels"),
        views("1", 1).expect(Psnr(5.0), "no depth"),
        views("2", 2).expect(Psnr(5.0), "unseen sides"),
        views("4", 4).expect(Psnr(5.0), "unseen sides"),
        views("500", 500).expect(Psnr(15.0), "fewer rays a pixel, more views"),
        enlarged("1×1", [1, 1]).expect(Finite, "no ground truth"),
        enlarged("2×2, from 1×1", [2, 2])
            .replace_prep(&json!({"lr_width": 1}))
            .expect(Finite, "one pixel a view"),
        enlarged("64×1", [64, 1]).expect(Finite, "no ground truth"),
        enlarged("4096×4096", [4096, 4096])
            .capture(|capture| {
                capture.train.truncate(4);
                capture.test.truncate(1);
            })
            .expect(Finite, "no ground truth"),
    ]
}

fn angle(case: &'static str, angle: f64, distance: f64) -> RowBuilder {
    row("angle of view", case)
        .capture(|capture| capture.surround(16, distance, pinhole(SIZE, angle)))
}

/// Takes training photographs through a lens, and test views through a pinhole.
fn lens(case: &'static str, angle: f64, distance: f64, lens: Distortion) -> RowBuilder {
    row("lens", case).capture(|capture| {
        let mut intrinsics = pinhole(SIZE, angle);
        intrinsics.distortion = lens;
        capture.surround(16, distance, intrinsics);
        let pinholes = Capture::default().test;
        capture.test = pinholes;
    })
}

/// Returns a distortion that folds at `multiple` times the radius of the image's corners.
fn folding(multiple: f64) -> Distortion {
    // x + k1·x³ has its maximum, 2/3·x, at x = 1/√(-3·k1).
    let corner = 2.0f64.sqrt() * (0.5 * 39.6f64.to_radians()).tan();
    let fold = 1.5 * multiple * corner;
    Distortion::brown([-1.0 / (3.0 * fold * fold), 0.0, 0.0], [0.0; 2])
}

fn lenses() -> Vec<Row> {
    use Expected::{Psnr, Refused};
    vec![
        angle("120°", 120.0, 1.6).expect(Psnr(10.0), "other photographs"),
        angle("170°", 170.0, 1.6).expect(Psnr(10.0), "the scene is a few pixels wide"),
        angle("179.9°", 179.9, 1.6).expect(Psnr(5.0), "the scene is less than a pixel"),
        angle("0.4°, 100 × as far", 0.4125, 100.0 * DISTANCE)
            .expect(Psnr(10.0), "other photographs"),
        angle("0.008°, 5000 × as far", 0.008_251, 5e3 * DISTANCE)
            .expect(Psnr(10.0), "other photographs"),
        angle("0.004°, 10⁴ × as far", 0.004_125, 1e4 * DISTANCE)
            .fast()
            .expect(Refused(3, "focal length"), ""),
        lens("fisheye", 120.0, DISTANCE, Distortion::fisheye([0.0; 4]))
            .expect(Psnr(10.0), "other photographs"),
        lens("folds at 1.5 × the corner", 39.6, DISTANCE, folding(1.5))
            .expect(Psnr(15.0), "other photographs"),
        lens("folds at 1.01 × the corner", 39.6, DISTANCE, folding(1.01))
            .expect(Psnr(15.0), "other photographs"),
        lens("folds at 0.99 × the corner", 39.6, DISTANCE, folding(0.99))
            .fast()
            .expect(Refused(3, "k1"), ""),
        lens("k1 = 1e6", 39.6, DISTANCE, Distortion::brown([1e6, 0.0, 0.0], [0.0; 2]))
            .expect(Psnr(3.0), "photographs of one direction"),
    ]
}

fn cameras() -> Vec<Row> {
    use Expected::{Like, Psnr};
    vec![
        row("cameras", "one 100 × as far")
            .capture(|capture| {
                let camera = &mut capture.train[3];
                for row in &mut camera.camera_to_world {
                    row[3] *= 100.0;
                }
            })
            .expect(Like(1.0), "one photograph less"),
        row("cameras", "one looks away")
            .capture(|capture| turn_away(&mut capture.train[3]))
            .expect(Like(1.0), "one photograph less"),
        row("cameras", "all look away")
            .capture(|capture| capture.cameras().for_each(turn_away))
            .expect(Psnr(30.0), "empty photographs"),
        row("cameras", "inside, looking outwards")
            .capture(|capture| {
                capture.backdrop = true;
                capture.surround(16, 0.3, pinhole(SIZE, 90.0));
                for camera in capture.cameras() {
                    turn_away(camera);
                    camera.camera_to_world[2][3] += 2.0;
                }
            })
            .expect(Psnr(10.0), "other photographs"),
        row("cameras", "one at the scene's centre")
            .capture(|capture| {
                for row in &mut capture.train[3].camera_to_world {
                    row[3] = 0.0;
                }
            })
            .expect(Like(3.0), "a photograph of the inside"),
        row("cameras", "all at one position")
            .capture(|capture| {
                capture.backdrop = true;
                capture.surround(16, 0.3, pinhole(SIZE, 90.0));
                for camera in capture.cameras() {
                    let forward = camera.forward();
                    let centre = DVec3::new(0.0, 0.0, 2.0);
                    camera.camera_to_world = looking_at(centre, centre - forward, DVec3::Z);
                }
            })
            .expect(Psnr(10.0), "no depth"),
        row("cameras", "one outlier pose")
            .capture(|capture| capture.outlier = Some(3))
            .expect(Psnr(10.0), "contradicting photographs"),
        row("cameras", "one outlier pose, refined")
            .capture(|capture| capture.outlier = Some(3))
            .train(&json!({"pose_refinement": true}))
            .expect(Psnr(10.0), "contradicting photographs"),
    ]
}

fn content(case: &'static str, content: Content) -> RowBuilder {
    row("images", case)
        .capture(|capture| capture.content = content)
        .setup(|setup| setup.export = true)
}

fn images() -> Vec<Row> {
    use Expected::{Finite, Psnr};
    vec![
        content("saturated", Content::Overexposed).fast().expect(Psnr(10.0), "other photographs"),
        content("white", Content::Constant(255)).fast().expect(Psnr(30.0), "flat"),
        content("black", Content::Constant(0)).fast().expect(Psnr(30.0), "flat"),
        content("grey", Content::Constant(128)).expect(Psnr(20.0), "flat"),
        content("noise", Content::Noise).expect(Finite, "nothing to learn"),
        content("transparent", Content::Transparent).expect(Psnr(30.0), "flat"),
    ]
}

fn range(case: &'static str, near: f64, far: f64) -> RowBuilder {
    row("near and far", case).prep(&json!({"near": near, "far": far}))
}

fn space(case: &'static str, space: &str) -> RowBuilder {
    let mut prep = json!({"space": space, "background": "white"});
    if space == "ndc" {
        merge(&mut prep, &json!({"near": 2, "far": 6}));
    }
    row("space and field", case).prep(&prep).capture(|capture| {
        if space == "ndc" {
            (capture.train, capture.test) = (forward("train", 16), forward("test", 4));
        }
    })
}

/// Trains the paper's field, with small networks.
fn mlp(builder: RowBuilder) -> RowBuilder {
    builder.setup(|setup| {
        setup.train = json!({"field": "mlp", "rays": 40_000, "layers": 2, "hidden_dim": 32,
            "max_rays_per_step": 512, "precrop_steps": 0});
    })
}

fn spaces() -> Vec<Row> {
    use Expected::{Like, Psnr, Refused};
    vec![
        range("2, 6", 2.0, 6.0).like(0.5),
        range("3, 3", 3.0, 3.0).fast().expect(Refused(2, "near"), ""),
        range("3, 3.000001", 3.0, 3.000_001).expect(Psnr(3.0), "all of the scene is cut off"),
        range("6, 2", 6.0, 2.0).fast().expect(Refused(2, "near"), ""),
        range("0, 1e18", 0.0, 1e18).like(0.5),
        range("0, 1e19", 0.0, 1e19).fast().expect(Refused(2, "far"), ""),
        space("box, grid", "box").expect(Like(0.15), ""),
        space("ndc, grid", "ndc").expect(Psnr(15.0), "other photographs"),
        space("contraction, grid", "contraction")
            .expect(Like(3.0), "half as many cells across the scene"),
        mlp(space("box, mlp", "box")).expect(Psnr(10.0), "a small MLP, briefly trained"),
        mlp(space("ndc, mlp", "ndc")).expect(Psnr(10.0), "a small MLP, briefly trained"),
        mlp(space("contraction, mlp", "contraction"))
            .expect(Psnr(10.0), "a small MLP, briefly trained"),
        mlp(row("unit", "1e-6, mlp"))
            .capture(|c| c.unit = 1e-6)
            .expect(Psnr(10.0), "a small MLP, briefly trained"),
        mlp(row("unit", "1e6, mlp"))
            .capture(|c| c.unit = 1e6)
            .expect(Psnr(10.0), "a small MLP, briefly trained"),
        mlp(row("origin", "ECEF, mlp"))
            .capture(|c| c.origin = ECEF)
            .expect(Psnr(10.0), "a small MLP, briefly trained"),
    ]
}
