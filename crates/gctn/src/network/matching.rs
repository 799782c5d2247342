//! Place first, then what was moved there is searched for in the observation.

use tch::{Kind, Tensor};

use super::compact::UNet;
use super::parameters::{Builder, Conv, Init, channels_last};
use super::{Features, FirstPlace, Fit};
use crate::Matching;
use crate::input::sequence;

/// What a cell of an image looks like, whatever else is in the other images: three convolutions on RGB and height.
#[derive(Debug)]
struct Embedding {
    layers: [Conv; 3],
    appearance: i64,
    features: i64,
}

impl Embedding {
    /// Unit vectors to search by, and features to correlate over turns; both at half resolution.
    fn forward(&self, image: &Tensor, kind: Kind) -> [Tensor; 2] {
        let [first, second, third] = &self.layers;
        let x = second.forward(&first.forward(image).relu_()).relu_();
        let x = third.forward(&x).to_kind(kind);
        [
            unit(&x.narrow(1, 0, self.appearance)),
            x.narrow(1, self.appearance, self.features),
        ]
    }
}

/// Vectors along channels, scaled to length 1.
fn unit(x: &Tensor) -> Tensor {
    const LEAST: f64 = 1e-12;
    let squares = (x * x).sum_dim_intlist([1].as_slice(), true, None::<Kind>);
    x / squares.clamp_min(LEAST).sqrt()
}

#[derive(Debug)]
pub(super) struct MatchingNet {
    trunk: UNet,
    embedding: Embedding,
    /// The 3x3 convolutions of all heads.
    heads: Conv,
    place: Conv,
    bias: Conv,
    query: Conv,
    key: Conv,
    gate: Conv,
    done: Conv,
    match_scale: Tensor,
    scale: Tensor,
    channels: i64,
    margin: i64,
    /// Whether candidates for the pick are compared with what was moved.
    has_candidates: bool,
}

/// Heads on the U-Net: place, pick bias, query, key with gate, done.
const HEADS: usize = 5;

impl MatchingNet {
    pub fn new(config: &Matching, inputs: usize, builder: &mut Builder) -> Self {
        let trunk = UNet::new(inputs, config.channels, &config.blocks, builder);
        let (hidden, channels) = (config.hidden_channels, config.channels[0]);
        let outputs = config.appearance_channels + config.feature_channels;
        let embedding = Embedding {
            layers: [
                builder.conv("embedding.first", [4, hidden], 4, 2, Init::FanIn),
                builder.conv("embedding.second", [hidden, hidden], 3, 1, Init::FanIn),
                builder.conv("embedding.third", [hidden, outputs], 3, 1, Init::FanIn),
            ],
            appearance: config.appearance_channels as i64,
            features: config.feature_channels as i64,
        };
        let heads = builder.conv("heads", [channels, HEADS * channels], 3, 1, Init::FanIn);
        let mut head =
            |name: &str, outputs: usize| builder.conv(name, [channels, outputs], 1, 1, Init::FanIn);
        let (place, bias) = (head("place", 1), head("bias", 1));
        let (query, key) = (
            head("query", config.context_channels),
            head("key", config.context_channels),
        );
        let (gate, done) = (head("gate", 1), head("done", 1));
        let correlated = config.feature_channels + config.context_channels;
        let correlated = config.window_cells as f64 * (correlated as f64).sqrt();
        Self {
            trunk,
            embedding,
            heads,
            place,
            bias,
            query,
            key,
            gate,
            done,
            match_scale: builder.scalar("match_scale", 10.0),
            scale: builder.scalar("scale", correlated.recip()),
            channels: channels as i64,
            margin: config.window_cells as i64 / 2,
            has_candidates: config.candidates > 0,
        }
    }

    pub fn forward(&self, input: &Tensor, kind: Kind) -> Features {
        let input = input.to_kind(kind);
        let x = self.heads.forward(&self.trunk.forward(&input)).relu_();
        let head = |index: i64, conv: &Conv| {
            let x = x.narrow(1, index * self.channels, self.channels);
            conv.at_each_cell(&x).to_kind(self.scale.kind())
        };
        let place = head(0, &self.place).squeeze_dim(1);
        // The place teaches the embedding what to look like, and not the other way round.
        let attention = place.detach().flatten(1, -1).softmax(-1, None::<Kind>);

        let image = |from: i64| input.narrow(1, from, 4);
        let both = Tensor::cat(&[image(sequence::OBSERVATION), image(sequence::IMAGE)], 0);
        let both = channels_last(&both);
        let [appearance, features] = self.embedding.forward(&both, self.scale.kind());
        let samples = input.size()[0];
        let (seen, shown) = (
            appearance.narrow(0, 0, samples),
            appearance.narrow(0, samples, samples),
        );
        let moved = shown
            .flatten(2, -1)
            .matmul(&attention.unsqueeze(-1))
            .unsqueeze(-1);
        let cosine = (seen * unit(&moved)).sum_dim_intlist([1].as_slice(), false, None::<Kind>);
        let pick = cosine * &self.match_scale + head(1, &self.bias).squeeze_dim(1);

        let gate = head(3, &self.gate).sigmoid();
        let (seen, shown) = (
            features.narrow(0, 0, samples),
            features.narrow(0, samples, samples),
        );
        let done = head(4, &self.done).flatten(1, -1);
        let margin = [self.margin; 4];
        let fit = self.has_candidates.then(|| {
            // gate (seen shown - seen^2 / 2 - shown^2 / 2) is -gate (seen - shown)^2 / 2.
            let half_square =
                |x: &Tensor| (x * x).sum_dim_intlist([1].as_slice(), true, None::<Kind>) * 0.5;
            let query = [seen.shallow_clone(), half_square(&seen), gate.ones_like()];
            let key = [&shown * &gate, -&gate, -&gate * half_square(&shown)];
            let images = [sequence::OBSERVATION, sequence::PREVIOUS, sequence::IMAGE];
            Fit {
                query: Tensor::cat(&query, 1),
                key: Tensor::cat(&key, 1).constant_pad_nd(margin),
                cells: images.map(|from| image(from).to_kind(self.scale.kind())),
            }
        });
        Features {
            pick,
            query: Tensor::cat(&[seen, head(2, &self.query)], 1),
            key: Tensor::cat(&[shown * gate, head(3, &self.key)], 1).constant_pad_nd(margin),
            scale: self.scale.shallow_clone(),
            first: Some(FirstPlace {
                fit,
                place,
                done: (done * attention).sum_dim_intlist([1].as_slice(), false, None::<Kind>),
            }),
        }
    }
}
