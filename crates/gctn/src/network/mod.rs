//! The networks, and what they share.

mod compact;
#[cfg(test)]
mod cross_check;
mod encoder;
mod gr_convnet;
mod heads;
mod matching;
mod parameters;
mod resnet43;

use tch::{Kind, Tensor};

use crate::input::{Encoding, Reading};
use crate::{Interpolation, Network, NetworkConfig, Precision};
use compact::CompactNet;
use gr_convnet::GrConvnetNet;
use matching::MatchingNet;
use resnet43::Resnet43Nets;

pub(crate) use encoder::Encoder;
pub(crate) use parameters::{Builder, Conv, Init, Parameters, channels_last, multiplications};

/// What a network says about a batch.
pub(crate) struct Features {
    /// Pick logits, N x rows x cols of the grid.
    pub pick: Tensor,
    /// Query features, N x C x rows x cols, with `query_margin` cells around.
    pub query: Tensor,
    /// Key features, N x C x rows x cols, with `margin` cells around.
    pub key: Tensor,
    /// Factor from correlation to logit.
    pub scale: Tensor,
    /// What a network says that finds the place first.
    pub first: Option<FirstPlace>,
}

/// What is said of the place before the pick is known.
pub(crate) struct FirstPlace {
    /// Place logits, N x rows x cols of the grid, whatever the pick and the turn: added to what the correlation says.
    pub place: Tensor,
    /// Logit that the step is done already, N.
    pub done: Tensor,
    /// By what candidates for the pick are compared with what was moved.
    pub fit: Option<Fit>,
}

/// Features whose correlation is minus half the squared difference of what is seen and what was shown, where that counts.
pub(crate) struct Fit {
    /// Of the observation, N x C x rows x cols.
    pub query: Tensor,
    /// Of v_k, N x C x rows x cols, with `margin` cells around.
    pub key: Tensor,
    /// Colour and height (4 channels) of the observation, of v_{k-1} and of v_k, by the cells of the heightmap, two for each of the grid
    /// along rows and columns: not learned.
    pub cells: [Tensor; 3],
}

impl Features {
    /// Those of some samples only.
    pub fn of(&self, samples: &[i64]) -> Self {
        let samples = Tensor::from_slice(samples).to_device(self.pick.device());
        let of = |tensor: &Tensor| tensor.index_select(0, &samples);
        Self {
            pick: of(&self.pick),
            query: of(&self.query),
            key: of(&self.key),
            scale: self.scale.shallow_clone(),
            first: self.first.as_ref().map(|first| FirstPlace {
                place: of(&first.place),
                done: of(&first.done),
                fit: first.fit.as_ref().map(|fit| Fit {
                    query: of(&fit.query),
                    key: of(&fit.key),
                    cells: fit.cells.each_ref().map(of),
                }),
            }),
        }
    }

    /// 0, however the weights change: a loss where there is nothing to learn from.
    pub fn nothing(&self) -> Tensor {
        let sum = |tensor: &Tensor| tensor.sum(None::<Kind>);
        let sums = sum(&self.pick) + sum(&self.query) + sum(&self.key) + sum(&self.scale);
        sums * 0.0
    }
}

/// The grid of a network's output, and its query window.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Grid {
    /// Cells along +y.
    pub rows: usize,
    /// Cells along +x.
    pub cols: usize,
    /// Heightmap cells per cell.
    pub stride: usize,
    /// Edge length of the query window, in cells.
    pub window: usize,
    /// Cells of the window before the pick; also the cells around the key features.
    pub margin: usize,
    /// Cells around the query features.
    pub query_margin: usize,
    /// How the query window is sampled.
    pub sampling: Interpolation,
    /// Whether the place is looked for between cells.
    pub subcell: bool,
}

impl Grid {
    /// Continuous index (0 at the centre of the first cell) of a continuous image coordinate.
    pub fn index(&self, coordinate_px: f64) -> f64 {
        coordinate_px / self.stride as f64 - 0.5
    }

    /// Continuous image coordinate of a continuous index.
    pub fn coordinate_px(&self, index: f64) -> f64 {
        (index + 0.5) * self.stride as f64
    }

    /// Row and column of a cell, which count row by row.
    pub fn row_and_col(&self, cell: usize) -> (usize, usize) {
        (cell / self.cols, cell % self.cols)
    }
}

#[derive(Debug)]
enum Nets {
    Compact(CompactNet),
    GrConvnet(GrConvnetNet),
    Resnet43(Resnet43Nets),
    Matching(MatchingNet),
}

/// A network with its weights.
#[derive(Debug)]
pub(crate) struct Model {
    pub config: NetworkConfig,
    pub parameters: Parameters,
    pub grid: Grid,
    pub precision: Precision,
    encoding: Encoding,
    nets: Nets,
}

impl Model {
    /// A network with weights from `builder`. The configuration must have been checked.
    pub fn new(config: &NetworkConfig, mut builder: Builder, precision: Precision) -> Self {
        let encoding = Encoding {
            reading: match config.network {
                Network::Resnet43(_) => Reading::Raw,
                Network::Compact(_) | Network::GrConvnet(_) => Reading::Difference,
                Network::Matching(_) => Reading::Sequence,
            },
            goals: config.conditioning.images(),
        };
        let inputs = encoding.channels();
        // Shared trunks answer at half resolution.
        let half = |window: usize, sampling: Interpolation| Grid {
            rows: config.rows / 2,
            cols: config.cols / 2,
            stride: 2,
            window,
            margin: window / 2,
            query_margin: 0,
            sampling,
            subcell: true,
        };
        let (nets, grid) = match &config.network {
            Network::Compact(compact) => (
                Nets::Compact(CompactNet::new(compact, inputs, &mut builder)),
                half(compact.window_cells, compact.rotation_sampling),
            ),
            Network::GrConvnet(gr_convnet) => (
                Nets::GrConvnet(GrConvnetNet::new(gr_convnet, inputs, &mut builder)),
                half(gr_convnet.window_cells, gr_convnet.rotation_sampling),
            ),
            Network::Matching(matching) => (
                Nets::Matching(MatchingNet::new(matching, inputs, &mut builder)),
                half(matching.window_cells, matching.rotation_sampling),
            ),
            Network::Resnet43(resnet43) => {
                let grid = Grid {
                    rows: config.rows,
                    cols: config.cols,
                    stride: 1,
                    window: resnet43.crop_px,
                    margin: resnet43.crop_px / 2,
                    query_margin: resnet43.crop_px / 2,
                    sampling: resnet43.rotation_sampling,
                    subcell: false,
                };
                (
                    Nets::Resnet43(Resnet43Nets::new(resnet43, encoding.goals, &mut builder)),
                    grid,
                )
            }
        };
        Self {
            config: config.clone(),
            parameters: builder.finish(),
            grid,
            encoding,
            precision,
            nets,
        }
    }

    /// Converts the weights for decisions. Later changes of the flat weights have no effect.
    pub fn prepare(&self) {
        self.parameters.prepare(self.kind());
    }

    /// From now on gradients reach the weights: gives what they are to be taken along. [`Parameters::cast`] comes before each
    /// forward pass after the weights have changed.
    pub fn learn(&mut self) -> Vec<Tensor> {
        let kind = self.kind();
        self.parameters.learn(kind)
    }

    /// Kind of numbers that the convolutions compute in.
    fn kind(&self) -> Kind {
        match self.precision {
            Precision::F32 => self.parameters.flat.kind(),
            Precision::Bf16 => Kind::BFloat16,
        }
    }

    /// Whether the network says if a step is done.
    pub fn says_done(&self) -> bool {
        matches!(self.nets, Nets::Matching(_))
    }

    /// What the network reads.
    pub fn encoding(&self) -> Encoding {
        self.encoding
    }

    /// Runs the convolutions. `input` is what [`crate::input::tensor`] makes, on the weights' device.
    pub fn forward(&self, input: &Tensor) -> Features {
        let input = input.to_kind(self.parameters.flat.kind());
        let kind = self.kind();
        match &self.nets {
            Nets::Compact(net) => net.forward(&input, kind),
            Nets::GrConvnet(net) => net.forward(&input, kind),
            Nets::Resnet43(nets) => nets.forward(&input, kind),
            Nets::Matching(net) => net.forward(&input, kind),
        }
    }
}
