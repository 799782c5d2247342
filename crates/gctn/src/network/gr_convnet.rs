//! A shared GR-ConvNet (Kumra, Joshi and Sahin, IROS 2020) at half resolution.

use tch::{Kind, Tensor};

use super::Features;
use super::heads::{Block, Heads};
use super::parameters::{Builder, Conv, Init, upsample};
use crate::GrConvnet;

#[derive(Debug)]
pub(super) struct GrConvnetNet {
    /// To strides 2, 4 and 8.
    downs: Vec<Conv>,
    blocks: Vec<Block>,
    /// To strides 4 and 2.
    ups: Vec<Conv>,
    heads: Heads,
}

impl GrConvnetNet {
    pub fn new(config: &GrConvnet, inputs: usize, builder: &mut Builder) -> Self {
        let channels = [1, 2, 4].map(|factor| factor * config.channels);
        let [fine, middle, coarse] = channels;
        let downs = [(inputs, fine), (fine, middle), (middle, coarse)];
        let down = |(index, (from, to)): (usize, (usize, usize)), builder: &mut Builder| {
            builder.conv(&format!("down{index}"), [from, to], 4, 2, Init::FanIn)
        };
        let up = |(index, (from, to)): (usize, (usize, usize)), builder: &mut Builder| {
            builder.conv(&format!("up{index}"), [from, to], 3, 1, Init::FanIn)
        };
        Self {
            downs: downs
                .into_iter()
                .enumerate()
                .map(|step| down(step, builder))
                .collect(),
            blocks: (0..config.blocks)
                .map(|index| Block::new(&format!("block{index}"), coarse, builder))
                .collect(),
            ups: [(coarse, middle), (middle, fine)]
                .into_iter()
                .enumerate()
                .map(|step| up(step, builder))
                .collect(),
            heads: Heads::new(fine, config.feature_channels, config.window_cells, builder),
        }
    }

    pub fn forward(&self, input: &Tensor, kind: Kind) -> Features {
        let mut x = input.to_kind(kind);
        for down in &self.downs {
            x = down.forward(&x).relu_();
        }
        for block in &self.blocks {
            x = block.forward(&x);
        }
        for up in &self.ups {
            x = up.forward(&upsample(&x)).relu_();
        }
        self.heads.forward(&x, input.kind())
    }
}
