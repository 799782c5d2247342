//! What shared trunks have in common.

use tch::{Kind, Tensor};

use super::Features;
use super::parameters::{Builder, Conv, Init};

/// Two 3x3 convolutions beside a shortcut; starts as the identity.
#[derive(Debug)]
pub(super) struct Block {
    first: Conv,
    second: Conv,
}

impl Block {
    pub fn new(name: &str, channels: usize, builder: &mut Builder) -> Self {
        let shape = [channels, channels];
        Self {
            first: builder.conv(&format!("{name}.first"), shape, 3, 1, Init::FanIn),
            second: builder.conv(&format!("{name}.second"), shape, 3, 1, Init::Zero),
        }
    }

    pub fn forward(&self, x: &Tensor) -> Tensor {
        let mut y = self.second.forward(&self.first.forward(x).relu_());
        y += x;
        y.relu_()
    }
}

/// Heads for pick logits, query and key features, on a trunk's features.
#[derive(Debug)]
pub(super) struct Heads {
    /// The 3x3 convolutions of all three heads.
    heads: Conv,
    pick: Conv,
    query: Conv,
    key: Conv,
    scale: Tensor,
    channels: i64,
    margin: i64,
}

impl Heads {
    /// On `channels` channels of the trunk.
    pub fn new(
        channels: usize,
        features: usize,
        window_cells: usize,
        builder: &mut Builder,
    ) -> Self {
        let correlated = window_cells as f64 * (features as f64).sqrt();
        Self {
            heads: builder.conv("heads", [channels, 3 * channels], 3, 1, Init::FanIn),
            pick: builder.conv("pick", [channels, 1], 1, 1, Init::FanIn),
            query: builder.conv("query", [channels, features], 1, 1, Init::FanIn),
            key: builder.conv("key", [channels, features], 1, 1, Init::FanIn),
            scale: builder.scalar("scale", correlated.recip()),
            channels: channels as i64,
            margin: window_cells as i64 / 2,
        }
    }

    /// Features of the given kind.
    pub fn forward(&self, x: &Tensor, kind: Kind) -> Features {
        let heads = self.heads.forward(x).relu_();
        let head = |index: i64, conv: &Conv| {
            let x = heads.narrow(1, index * self.channels, self.channels);
            conv.at_each_cell(&x).to_kind(kind)
        };
        Features {
            pick: head(0, &self.pick).squeeze_dim(1),
            query: head(1, &self.query),
            key: head(2, &self.key).constant_pad_nd([self.margin; 4]),
            scale: self.scale.shallow_clone(),
            first: None,
        }
    }
}
