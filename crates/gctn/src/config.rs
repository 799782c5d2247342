//! Configuration of networks and of training.

use heightmap::Workspace;
use serde::{Deserialize, Serialize};

use crate::Error;

/// A network and the grid it works on: what a checkpoint needs besides its weights.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetworkConfig {
    /// Rows of the heightmaps (along +y).
    #[serde(default = "rows")]
    pub rows: usize,
    /// Columns of the heightmaps (along +x).
    #[serde(default = "cols")]
    pub cols: usize,
    /// Edge length of a cell of the heightmaps.
    #[serde(default = "pixel_size_m")]
    pub pixel_size_m: f64,
    /// Number of place rotations, spread evenly over a full turn.
    #[serde(default = "rotations")]
    pub rotations: usize,
    /// Which image of the demonstration the network is shown as its goal.
    #[serde(default)]
    pub conditioning: GoalConditioning,
    /// The network.
    pub network: Network,
}

fn rows() -> usize {
    Workspace::RAVENS.rows
}

fn cols() -> usize {
    Workspace::RAVENS.cols
}

fn pixel_size_m() -> f64 {
    Workspace::RAVENS.pixel_size_m
}

fn rotations() -> usize {
    36
}

/// Which image of the demonstration sequence is the goal (paper, section IV-A).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GoalConditioning {
    /// The first observation with a delta reward after the present step (SCTN).
    #[default]
    NextStep,
    /// The last observation of the demonstration (GCTN).
    Final,
    /// Both, in this order.
    Both,
    /// The observations before and after the next step of a demonstration, v_{k-1} and v_k, which may begin from
    /// another start than the present episode: what it changed, not what the table looks like.
    Sequence,
}

impl GoalConditioning {
    /// How many images that is.
    pub(crate) const fn images(self) -> usize {
        match self {
            Self::NextStep | Self::Final => 1,
            Self::Both | Self::Sequence => 2,
        }
    }
}

/// As in configuration files.
impl std::fmt::Display for GoalConditioning {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str(match self {
            Self::NextStep => "next_step",
            Self::Final => "final",
            Self::Both => "both",
            Self::Sequence => "sequence",
        })
    }
}

/// The networks to choose from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Network {
    /// Four ResNet43_8s nets as published: pick, query, key, goal.
    Resnet43(Resnet43),
    /// One shared U-Net with three small heads.
    Compact(Compact),
    /// One shared GR-ConvNet with the same three heads.
    GrConvnet(GrConvnet),
    /// A U-Net that says where something appeared in the demonstration, and an embedding by which the observation is
    /// searched for it.
    Matching(Matching),
}

/// The published Goal-Conditioned Transporter Network (Seita et al., ICRA 2021; paper, section III-B).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Resnet43 {
    /// Edge length of the query window round the pick. Even.
    pub crop_px: usize,
    /// Feature channels of the place nets.
    pub feature_channels: usize,
    /// How the query window is rotated.
    pub rotation_sampling: Interpolation,
}

impl Default for Resnet43 {
    fn default() -> Self {
        Self {
            crop_px: 64,
            feature_channels: 3,
            rotation_sampling: Interpolation::Nearest,
        }
    }
}

/// A shared-trunk U-Net at half resolution that learns in minutes on one core.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Compact {
    /// Channels at strides 2, 4, 8 and 16.
    pub channels: [usize; 4],
    /// Residual blocks at strides 2, 4, 8 and 16.
    pub blocks: [usize; 4],
    /// Query and key feature channels.
    pub feature_channels: usize,
    /// Edge length of the query window round the pick, in cells of stride 2. Odd.
    pub window_cells: usize,
    /// How the query window is rotated.
    pub rotation_sampling: Interpolation,
}

impl Default for Compact {
    fn default() -> Self {
        Self {
            channels: [16, 32, 64, 128],
            blocks: [1, 1, 1, 2],
            feature_channels: 8,
            window_cells: 25,
            rotation_sampling: Interpolation::Bilinear,
        }
    }
}

/// A trunk after GR-ConvNet (Kumra, Joshi and Sahin, IROS 2020): convolutions down to stride 8, residual blocks there, and up again
/// without skips. Without batch norm, and its input and output are at half resolution.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GrConvnet {
    /// Channels at stride 2; twice as many at 4, four times at 8.
    pub channels: usize,
    /// Residual blocks at stride 8.
    pub blocks: usize,
    /// Query and key feature channels.
    pub feature_channels: usize,
    /// Edge length of the query window round the pick, in cells of stride 2. Odd.
    pub window_cells: usize,
    /// How the query window is rotated.
    pub rotation_sampling: Interpolation,
}

impl Default for GrConvnet {
    fn default() -> Self {
        Self {
            channels: 32,
            blocks: 5,
            feature_channels: 8,
            window_cells: 25,
            rotation_sampling: Interpolation::Bilinear,
        }
    }
}

/// A network for the conditioning `sequence`, place first. A U-Net over all images says where something appeared between
/// v_{k-1} and v_k: the place. An embedding of v_k pooled there is searched for in the observation: the pick. What
/// stands at the pick, turned, is correlated with what stands in v_k: the turn, and the place that belongs to this pick.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Matching {
    /// Channels of the U-Net at strides 2, 4, 8 and 16.
    pub channels: [usize; 4],
    /// Residual blocks of the U-Net at strides 2, 4, 8 and 16.
    pub blocks: [usize; 4],
    /// Hidden channels of the embedding.
    pub hidden_channels: usize,
    /// Channels by which the observation is searched.
    pub appearance_channels: usize,
    /// Channels of the embedding that are correlated over turns.
    pub feature_channels: usize,
    /// Query and key channels of the U-Net, correlated beside them.
    pub context_channels: usize,
    /// How many peaks of the pick map are compared, window by window, with what stands at the place: the squared difference of
    /// the features decides among them. 0: the pick map alone decides.
    #[serde(skip_serializing_if = "is_zero")]
    pub candidates: usize,
    /// Weight of what the cells themselves say of turns: the mean squared difference of colours, and of heights relative to the thing
    /// that is moved, where something appeared in v_k. It counts in training too. 0: nothing.
    #[serde(skip_serializing_if = "is_nothing")]
    pub shape_weight: f64,
    /// Weight of what the cells themselves say of candidates: the same difference. It takes at most 2 from a logit, and nothing where
    /// no candidate is like what was moved. 0: nothing.
    #[serde(skip_serializing_if = "is_nothing")]
    pub pick_shape_weight: f64,
    /// Weight of how high candidates stand above what is around them, against how high v_k has risen at the place: half the squared
    /// difference, in 40 mm. It takes at most 2 from a logit, where `pick_shape_weight` takes something. 0: nothing.
    #[serde(skip_serializing_if = "is_nothing")]
    pub pick_height_weight: f64,
    /// Whether turns are compared by the cells of the heightmap in place of those of stride 2: small things show no turn in these. A
    /// larger `shape_weight` is right then.
    #[serde(skip_serializing_if = "is_false")]
    pub fine_shapes: bool,
    /// Edge length of the query window round the pick, in cells of stride 2. Odd.
    pub window_cells: usize,
    /// How the query window is rotated.
    pub rotation_sampling: Interpolation,
}

impl Default for Matching {
    fn default() -> Self {
        Self {
            channels: [16, 32, 64, 96],
            blocks: [1, 1, 1, 2],
            hidden_channels: 24,
            appearance_channels: 16,
            feature_channels: 6,
            context_channels: 4,
            candidates: 0,
            shape_weight: 0.0,
            pick_shape_weight: 0.0,
            pick_height_weight: 0.0,
            fine_shapes: false,
            window_cells: 21,
            rotation_sampling: Interpolation::Bilinear,
        }
    }
}

/// Checkpoints of before there were candidates do not mention them.
#[expect(
    clippy::trivially_copy_pass_by_ref,
    reason = "serde passes a reference"
)]
fn is_zero(count: &usize) -> bool {
    *count == 0
}

#[expect(
    clippy::trivially_copy_pass_by_ref,
    reason = "serde passes a reference"
)]
fn is_nothing(weight: &f64) -> bool {
    *weight == 0.0
}

#[expect(
    clippy::trivially_copy_pass_by_ref,
    reason = "serde passes a reference"
)]
fn is_false(value: &bool) -> bool {
    !value
}

/// How an image is sampled between its cells.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Interpolation {
    /// The nearest cell: edges stay sharp.
    #[default]
    Nearest,
    /// The mean of the four nearest cells, by distance.
    Bilinear,
}

fn check(
    what: &'static str,
    good: bool,
    actual: impl ToString,
    expected: &'static str,
) -> Result<(), Error> {
    if good {
        return Ok(());
    }
    Err(Error::Config {
        what,
        actual: actual.to_string(),
        expected,
    })
}

impl NetworkConfig {
    /// A network on the Ravens workspace, 36 rotations, next-step goals.
    pub fn new(network: Network) -> Self {
        Self {
            rows: rows(),
            cols: cols(),
            pixel_size_m: pixel_size_m(),
            rotations: rotations(),
            conditioning: GoalConditioning::default(),
            network,
        }
    }

    /// The compact network with its default sizes.
    pub fn compact() -> Self {
        Self::new(Network::Compact(Compact::default()))
    }

    /// The matching network with its default sizes, conditioned on a sequence.
    pub fn matching() -> Self {
        Self {
            conditioning: GoalConditioning::Sequence,
            ..Self::new(Network::Matching(Matching::default()))
        }
    }

    /// The published network.
    pub fn resnet43() -> Self {
        Self::new(Network::Resnet43(Resnet43::default()))
    }

    /// Refuses sizes that no network can be made of.
    pub fn check(&self) -> Result<(), Error> {
        check_size([self.rows, self.cols], self.pixel_size_m)?;
        let good = (1..=360).contains(&self.rotations);
        check("rotations", good, self.rotations, "1 to 360")?;
        let channels = |channels: &usize| (1..=1024).contains(channels);
        let heads = |features: usize, window_cells: usize| {
            check(
                "feature_channels",
                channels(&features),
                features,
                "1 to 1024",
            )?;
            let good = (3..=255).contains(&window_cells) && window_cells % 2 == 1;
            let expected = "an odd number from 3 to 255";
            check("window_cells", good, window_cells, expected)
        };
        match &self.network {
            Network::Resnet43(Resnet43 {
                crop_px,
                feature_channels,
                ..
            }) => {
                let good = (16..=256).contains(crop_px) && crop_px.is_multiple_of(16);
                check("crop_px", good, crop_px, "a multiple of 16 from 16 to 256")?;
                let good = channels(feature_channels);
                check("feature_channels", good, feature_channels, "1 to 1024")
            }
            Network::Compact(compact) => {
                let good = compact.channels.iter().all(channels);
                let actual = format!("{:?}", compact.channels);
                check("channels", good, actual, "1 to 1024 each")?;
                let good = compact.blocks.iter().all(|blocks| *blocks <= 16);
                let actual = format!("{:?}", compact.blocks);
                check("blocks", good, actual, "0 to 16 each")?;
                heads(compact.feature_channels, compact.window_cells)
            }
            Network::GrConvnet(gr_convnet) => {
                let GrConvnet {
                    channels, blocks, ..
                } = *gr_convnet;
                check(
                    "channels",
                    (1..=256).contains(&channels),
                    channels,
                    "1 to 256",
                )?;
                check("blocks", blocks <= 16, blocks, "0 to 16")?;
                heads(gr_convnet.feature_channels, gr_convnet.window_cells)
            }
            Network::Matching(matching) => {
                let good = self.conditioning == GoalConditioning::Sequence;
                check(
                    "conditioning",
                    good,
                    self.conditioning,
                    "sequence for the network matching",
                )?;
                let good = matching.channels.iter().all(channels);
                let actual = format!("{:?}", matching.channels);
                check("channels", good, actual, "1 to 1024 each")?;
                let good = matching.blocks.iter().all(|blocks| *blocks <= 16);
                let actual = format!("{:?}", matching.blocks);
                check("blocks", good, actual, "0 to 16 each")?;
                for (what, value) in [
                    ("hidden_channels", matching.hidden_channels),
                    ("appearance_channels", matching.appearance_channels),
                    ("context_channels", matching.context_channels),
                ] {
                    check(what, channels(&value), value, "1 to 1024")?;
                }
                let good = matching.candidates != 1 && matching.candidates <= 64;
                check("candidates", good, matching.candidates, "0, or 2 to 64")?;
                for (what, weight) in [
                    ("shape_weight", matching.shape_weight),
                    ("pick_shape_weight", matching.pick_shape_weight),
                    ("pick_height_weight", matching.pick_height_weight),
                ] {
                    let good =
                        (0.0..=1e3).contains(&weight) && (weight == 0.0 || matching.candidates > 0);
                    check(what, good, weight, "0 to 1000, and 0 without candidates")?;
                }
                let weight = matching.pick_height_weight;
                let good = weight == 0.0 || matching.pick_shape_weight > 0.0;
                let expected = "0 without a pick_shape_weight";
                check("pick_height_weight", good, weight, expected)?;
                heads(matching.feature_channels, matching.window_cells)
            }
        }
    }

    /// How many candidates for the pick are compared with what stands at the place.
    pub(crate) fn candidates(&self) -> usize {
        match &self.network {
            Network::Matching(matching) => matching.candidates,
            Network::Compact(_) | Network::GrConvnet(_) | Network::Resnet43(_) => 0,
        }
    }

    /// Weights of the cells themselves in comparing turns, and of shapes and heights in comparing candidates.
    pub(crate) fn shape_weights(&self) -> [f64; 3] {
        match &self.network {
            Network::Matching(matching) => [
                matching.shape_weight,
                matching.pick_shape_weight,
                matching.pick_height_weight,
            ],
            Network::Compact(_) | Network::GrConvnet(_) | Network::Resnet43(_) => [0.0; 3],
        }
    }

    /// Whether the cells of the heightmap themselves are compared for turns.
    pub(crate) fn has_fine_shapes(&self) -> bool {
        matches!(&self.network, Network::Matching(matching) if matching.fine_shapes)
    }

    /// Whether both networks have the same weights: what compares candidates has none.
    pub(crate) fn has_weights_of(&self, other: &Self) -> bool {
        let without = |config: &Self| {
            let mut config = config.clone();
            if let Network::Matching(matching) = &mut config.network {
                matching.candidates = 0;
                matching.shape_weight = 0.0;
                matching.pick_shape_weight = 0.0;
                matching.pick_height_weight = 0.0;
                matching.fine_shapes = false;
            }
            config
        };
        without(self) == without(other)
    }

    /// Refuses heightmaps of another grid: the network has learned this one.
    pub fn check_workspace(&self, workspace: &Workspace) -> Result<(), Error> {
        check_grid([self.rows, self.cols], self.pixel_size_m, workspace)
    }
}

fn check_grid(
    [rows, cols]: [usize; 2],
    pixel_size_m: f64,
    workspace: &Workspace,
) -> Result<(), Error> {
    let same_pixel = (workspace.pixel_size_m - pixel_size_m).abs() < 1e-9;
    if (workspace.rows, workspace.cols) == (rows, cols) && same_pixel {
        return Ok(());
    }
    Err(Error::Workspace {
        actual: format!(
            "{}x{} cells of {} m",
            workspace.rows, workspace.cols, workspace.pixel_size_m
        ),
        expected: format!("{rows}x{cols} cells of {pixel_size_m} m"),
    })
}

/// Refuses a grid that no network can be made for.
fn check_size([rows, cols]: [usize; 2], pixel_size_m: f64) -> Result<(), Error> {
    let size = |size: usize| (16..=4096).contains(&size) && size.is_multiple_of(16);
    let a_size = "a multiple of 16 from 16 to 4096";
    check("rows", size(rows), rows, a_size)?;
    check("cols", size(cols), cols, a_size)?;
    let good = pixel_size_m.is_finite() && pixel_size_m > 0.0;
    check("pixel_size_m", good, pixel_size_m, "a positive number")
}

/// How a network is trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingConfig {
    /// Seed of weights, augmentation and wrong rotations.
    pub seed: u64,
    /// Gradient steps in all; the schedule ends there.
    pub steps: u64,
    /// Samples a gradient step.
    pub batch: usize,
    /// Largest learning rate.
    pub learning_rate: f64,
    /// Learning rate after the warm-up.
    pub schedule: Schedule,
    /// Steps over which the learning rate rises linearly from 0.
    pub warm_up_steps: u64,
    /// Decoupled weight decay of AdamW (Loshchilov and Hutter, 2019); 0 makes it Adam.
    pub weight_decay: f64,
    /// Largest norm of the gradient; none leaves it as it is.
    pub gradient_clip: Option<f64>,
    /// Place loss.
    pub place_loss: PlaceLoss,
    /// Standard deviation of the Gaussian that softens labels, in cells of the logits; 0: one hot.
    pub label_sigma_cells: f64,
    /// Augmentation of samples.
    pub augmentation: Augmentation,
    /// Kind of the convolutions' arithmetic; weights and optimiser stay f32.
    #[serde(default)]
    pub precision: Precision,
    /// Threads of libtorch. Sums are split by thread: another number gives other last bits.
    pub threads: usize,
    /// Where to compute.
    #[serde(default)]
    pub device: Device,
}

/// Learning rate after the warm-up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Schedule {
    /// Stays.
    Constant,
    /// Half a cosine down to 0 at the last step.
    Cosine,
}

/// Cross entropies that teach the place maps.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PlaceLoss {
    /// Over all cells and rotations, as published.
    AllRotations,
    /// Over all cells at the right rotation and a random wrong one, plus over all rotations at the true
    /// place: nearly all of the signal for a fraction of the work.
    RightAndOneWrong,
}

/// Kind of the convolutions' arithmetic.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Precision {
    /// 32-bit floats.
    #[default]
    F32,
    /// Brain floats of 16 bits; f32 on a processor without instructions for them: [`Precision::on`].
    Bf16,
}

/// Where to compute: as text `cpu`, `cuda` (the first card) or `cuda:N`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Device {
    /// The processor.
    #[default]
    Cpu,
    /// A CUDA device, by its number.
    Cuda(usize),
}

/// Random rigid motions, and colours, of a sample (Zeng et al., CoRL 2020).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Augmentation {
    /// Standard deviation of the rotation about the middle of the image.
    pub rotation_sigma_deg: f64,
    /// Standard deviation of the translation along each axis.
    pub translation_sigma_px: f64,
    /// How images are sampled. Bilinear makes heights at edges that nothing has.
    pub interpolation: Interpolation,
    /// Share of samples whose colours are turned about the grey axis by a random angle, observation
    /// and goal alike.
    pub hue_probability: f64,
    /// Standard deviation of the logarithm of a gain on each colour channel, observation and goal alike.
    pub gain_sigma: f64,
    /// Share of samples whose colour channels change places, in all images alike.
    pub permutation_probability: f64,
    /// Share of samples that are mirrored, all images alike; the turn changes its sign.
    pub mirror_probability: f64,
    /// What is drawn for each image on its own.
    pub sensor: SensorNoise,
}

/// What another exposure does to an image: drawn for each image of a sample on its own.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SensorNoise {
    /// Standard deviation of the logarithm of a gain on all colours.
    pub gain_sigma: f64,
    /// Standard deviation of the logarithm of a further gain on each colour channel.
    pub tint_sigma: f64,
    /// Largest error of a colour of a cell, of 255; uniform.
    pub color_noise: f64,
    /// Largest error of the height of a cell; uniform.
    pub height_noise_m: f64,
    /// Standard deviation of an error of all heights.
    pub height_offset_sigma_m: f64,
    /// Share of cells whose height is missing and reads 0.
    pub hole_share: f64,
}

impl SensorNoise {
    /// None at all.
    pub const NONE: Self = Self {
        gain_sigma: 0.0,
        tint_sigma: 0.0,
        color_noise: 0.0,
        height_noise_m: 0.0,
        height_offset_sigma_m: 0.0,
        hole_share: 0.0,
    };
}

impl Augmentation {
    /// None at all.
    pub const NONE: Self = Self {
        rotation_sigma_deg: 0.0,
        translation_sigma_px: 0.0,
        interpolation: Interpolation::Nearest,
        hue_probability: 0.0,
        gain_sigma: 0.0,
        permutation_probability: 0.0,
        mirror_probability: 0.0,
        sensor: SensorNoise::NONE,
    };
}

impl Default for Augmentation {
    /// As published: N(0, 60 deg) and N(0, 26.67 px), no colours.
    fn default() -> Self {
        Self {
            rotation_sigma_deg: 60.0,
            translation_sigma_px: 160.0 / 6.0,
            ..Self::NONE
        }
    }
}

impl TrainingConfig {
    /// What trained the compact network fastest: AdamW, cosine, batch 4.
    pub fn compact() -> Self {
        Self {
            seed: 0,
            steps: 2000,
            batch: 4,
            learning_rate: 1e-3,
            schedule: Schedule::Cosine,
            warm_up_steps: 50,
            weight_decay: 0.01,
            gradient_clip: Some(5.0),
            place_loss: PlaceLoss::RightAndOneWrong,
            label_sigma_cells: 0.7,
            augmentation: Augmentation::default(),
            precision: Precision::F32,
            threads: 1,
            device: Device::Cpu,
        }
    }

    /// Training as published: Adam at 1e-4, one sample a step, 20,000 steps a task module.
    pub fn published() -> Self {
        Self {
            steps: 20_000,
            batch: 1,
            learning_rate: 1e-4,
            schedule: Schedule::Constant,
            warm_up_steps: 0,
            weight_decay: 0.0,
            gradient_clip: None,
            place_loss: PlaceLoss::AllRotations,
            label_sigma_cells: 0.0,
            threads: 2,
            ..Self::compact()
        }
    }

    /// Refuses values that cannot train.
    pub fn check(&self) -> Result<(), Error> {
        let not_negative = |value: f64| value.is_finite() && value >= 0.0;
        let rate = self.learning_rate;
        let augmentation = &self.augmentation;
        let sensor = &augmentation.sensor;
        check("steps", self.steps > 0, self.steps, "at least 1")?;
        let good = (1..=1024).contains(&self.batch);
        check("batch", good, self.batch, "1 to 1024")?;
        let good = rate.is_finite() && rate > 0.0;
        check("learning_rate", good, rate, "a positive number")?;
        if let Some(clip) = self.gradient_clip {
            let good = clip.is_finite() && clip > 0.0;
            check("gradient_clip", good, clip, "a positive number or nothing")?;
        }
        for (what, value) in [
            ("weight_decay", self.weight_decay),
            ("label_sigma_cells", self.label_sigma_cells),
            ("rotation_sigma_deg", augmentation.rotation_sigma_deg),
            ("translation_sigma_px", augmentation.translation_sigma_px),
            ("gain_sigma", augmentation.gain_sigma),
            ("sensor.gain_sigma", sensor.gain_sigma),
            ("sensor.tint_sigma", sensor.tint_sigma),
            ("sensor.color_noise", sensor.color_noise),
            ("sensor.height_noise_m", sensor.height_noise_m),
            ("sensor.height_offset_sigma_m", sensor.height_offset_sigma_m),
        ] {
            check(what, not_negative(value), value, "0 or a positive number")?;
        }
        for (what, share) in [
            ("hue_probability", augmentation.hue_probability),
            (
                "permutation_probability",
                augmentation.permutation_probability,
            ),
            ("mirror_probability", augmentation.mirror_probability),
            ("sensor.hole_share", sensor.hole_share),
        ] {
            check(what, (0.0..=1.0).contains(&share), share, "0 to 1")?;
        }
        let good = (1..=1024).contains(&self.threads);
        check("threads", good, self.threads, "1 to 1024")
    }
}

/// A network that embeds heightmaps, and the grid it works on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct EmbeddingConfig {
    /// Rows of the heightmaps (along +y).
    pub rows: usize,
    /// Columns of the heightmaps (along +x).
    pub cols: usize,
    /// Edge length of a cell of the heightmaps.
    pub pixel_size_m: f64,
    /// Channels at strides 2, 4, 8 and 16, one residual block each.
    pub channels: [usize; 4],
    /// Numbers for each cell of stride 16.
    pub features: usize,
}

impl Default for EmbeddingConfig {
    fn default() -> Self {
        Self {
            rows: rows(),
            cols: cols(),
            pixel_size_m: pixel_size_m(),
            channels: [16, 32, 64, 64],
            features: 8,
        }
    }
}

impl EmbeddingConfig {
    /// Refuses sizes that no network can be made of.
    pub fn check(&self) -> Result<(), Error> {
        check_size([self.rows, self.cols], self.pixel_size_m)?;
        let number = |number: &usize| (1..=1024).contains(number);
        let good = self.channels.iter().all(number);
        let actual = format!("{:?}", self.channels);
        check("channels", good, actual, "1 to 1024 each")?;
        let good = number(&self.features);
        check("features", good, self.features, "1 to 1024")
    }

    /// Refuses heightmaps of another grid: the network has learned this one.
    pub fn check_workspace(&self, workspace: &Workspace) -> Result<(), Error> {
        check_grid([self.rows, self.cols], self.pixel_size_m, workspace)
    }
}

/// How an embedding is trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct EmbeddingTraining {
    /// Seed of weights and of all that is drawn.
    pub seed: u64,
    /// Gradient steps in all; the learning rate ends there, at 0.
    pub steps: u64,
    /// Demonstrations a gradient step.
    pub batch: usize,
    /// Largest learning rate.
    pub learning_rate: f64,
    /// Steps over which the learning rate rises linearly from 0.
    pub warm_up_steps: u64,
    /// The same for all images of a demonstration.
    pub augmentation: Augmentation,
    /// Standard deviation of the smooth displacement of an image against its other view.
    pub displacement_sigma_px: f64,
    /// Edge of the cells within which that displacement is smooth.
    pub displacement_spacing_px: usize,
    /// Largest error of a colour of the other view, of 255.
    pub color_noise: f64,
    /// Largest error of a height of the other view.
    pub height_noise_m: f64,
    /// Threads of libtorch. Sums are split by thread: another number gives other last bits.
    pub threads: usize,
}

impl Default for EmbeddingTraining {
    fn default() -> Self {
        Self {
            seed: 0,
            steps: 400,
            batch: 2,
            learning_rate: 1e-3,
            warm_up_steps: 20,
            augmentation: Augmentation::default(),
            displacement_sigma_px: 3.0,
            displacement_spacing_px: 32,
            color_noise: 12.0,
            height_noise_m: 0.003,
            threads: 1,
        }
    }
}

impl EmbeddingTraining {
    /// Refuses values that cannot train.
    pub fn check(&self) -> Result<(), Error> {
        let like = TrainingConfig {
            steps: self.steps,
            batch: self.batch,
            learning_rate: self.learning_rate,
            augmentation: self.augmentation.clone(),
            threads: self.threads,
            ..TrainingConfig::compact()
        };
        like.check()?;
        for (what, value) in [
            ("displacement_sigma_px", self.displacement_sigma_px),
            ("color_noise", self.color_noise),
            ("height_noise_m", self.height_noise_m),
        ] {
            let good = value.is_finite() && value >= 0.0;
            check(what, good, value, "0 or a positive number")?;
        }
        let spacing = self.displacement_spacing_px;
        let good = (2..=4096).contains(&spacing);
        check("displacement_spacing_px", good, spacing, "2 to 4096")
    }
}
