//! The field's constants: shared by the fused passes, their f64 judge and the libtorch twin.

/// Features of a grid vertex.
pub const FEATURES: usize = 4;
/// Vertices of a brick, which lie together in memory: 2³.
pub const BRICK: usize = 8;
/// Factors of a brick's y and z coordinates in its hash (Müller et al. 2022, eq. 4); x has 1.
pub const HASH_FACTORS: [u32; 2] = [2_654_435_761, 805_459_861];

/// Outputs of the density network: raw density, the colour's raw red, green and blue, and the view
/// features.
pub const DENSITY_OUTPUTS: usize = 16;
/// First raw colour and first view feature among those outputs.
pub const RAW_COLOUR: usize = 1;
/// See [`RAW_COLOUR`].
pub const VIEW_FEATURE: usize = 4;
/// View features: composited along a ray, they are what the view network gets besides the
/// direction.
pub const VIEW_FEATURES: usize = DENSITY_OUTPUTS - VIEW_FEATURE;
/// Spherical harmonics of a direction, up to degree 2.
pub const BASIS: usize = 9;
/// Inputs of the view network.
pub const VIEW_INPUTS: usize = VIEW_FEATURES + BASIS;
/// Raw density stops growing here: a step is opaque long before e^15.
pub const MAX_RAW_DENSITY: f32 = 15.0;

/// Samples behind this transmittance, and samples of less weight, have no colour and no gradient.
pub const FAINT: f32 = 1e-4;
/// A ray whose samples weigh no more in all has its depth at the far end.
pub const UNSEEN: f32 = 1e-4;
/// Optical depth at which a ray ends: -ln([`FAINT`]).
pub const DARK: f32 = 9.210_34;
/// Samples of each ray in the first rounds of a training and in all later ones: few while a surface
/// may stop the ray, then more. A ray that is dark ([`DARK`]) takes no further round.
pub const TRAINING_ROUNDS: [usize; 4] = [8, 8, 16, 32];

/// How far apart colours at most are for matter to pass for the background.
pub const LIKE_BACKGROUND: f32 = 0.1;

/// Cells of the occupancy along each axis of the unit cube.
pub const OCCUPANCY_CELLS: usize = 128;
/// Optical depth of a step below which a cell is thin: in training, rays take a sample of double
/// length at every other step.
pub const THIN: f32 = 0.05;
/// Optical depth of a step below which a cell is empty, once the mean is above it.
pub const EMPTY: f32 = 0.01;

/// Weight of a sample above which its cell keeps the density found there: a random place may miss a
/// thin surface, and the cell would become empty.
pub const MET: f32 = 0.03;

/// Adam's decay of the two moments of gradients. The second moment forgets sooner than usual, since
/// a grid entry is seen now and then.
pub const ADAM_BETA: [f64; 2] = [0.9, 0.99];
/// What keeps Adam's division from 0.
pub const ADAM_EPSILON: f64 = 1e-15;
