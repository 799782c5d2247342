//! Seeds of an episode: the scene apart from the start.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::fmt;

/// Which scene of a problem, and which start of it.
///
/// The scene seed draws fixtures, objects and goal; the start seed draws where the loose objects lie
/// at first. A number alone means the scene with its own start: both seeds are that number.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct EpisodeSeed {
    /// Draws fixtures, objects and goal.
    pub scene: u64,
    /// Draws where the loose objects lie. Equal to `scene`: the scene's own start.
    pub start: u64,
}

impl EpisodeSeed {
    /// Whether this is the start that the scene's seed alone gives.
    pub fn is_own_start(&self) -> bool {
        self.start == self.scene
    }
}

impl From<u64> for EpisodeSeed {
    fn from(seed: u64) -> Self {
        Self {
            scene: seed,
            start: seed,
        }
    }
}

impl fmt::Display for EpisodeSeed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.scene)?;
        if !self.is_own_start() {
            write!(f, ", start {}", self.start)?;
        }
        Ok(())
    }
}

/// The random numbers that a task module draws an episode's task from.
pub struct Draws {
    scene: ChaCha8Rng,
    /// None for the scene's own start.
    start: Option<ChaCha8Rng>,
}

impl Draws {
    /// Draws of the module with this index in its problem.
    pub fn new(seed: EpisodeSeed, module: u64) -> Self {
        let start = || {
            let mut key = [0; 32];
            key[..8].copy_from_slice(&seed.scene.to_le_bytes());
            key[8..16].copy_from_slice(&seed.start.to_le_bytes());
            key[16..21].copy_from_slice(b"start");
            let mut rng = ChaCha8Rng::from_seed(key);
            rng.set_stream(module);
            rng
        };
        Self {
            scene: stream(seed.scene, module),
            start: (!seed.is_own_start()).then(start),
        }
    }

    /// The stream for fixtures, objects and goal.
    pub fn scene(&mut self) -> &mut ChaCha8Rng {
        &mut self.scene
    }

    /// Draws a part of the start. The scene's own is drawn from the scene's stream in any case, so
    /// that what is drawn next from that stream is the same whatever the start.
    pub fn start<T>(&mut self, mut draw: impl FnMut(&mut ChaCha8Rng) -> T) -> T {
        let own = draw(&mut self.scene);
        self.start.as_mut().map_or(own, draw)
    }

    /// The stream of a start that is not the scene's own: for what does not vary in that one.
    pub fn other_start(&mut self) -> Option<&mut ChaCha8Rng> {
        self.start.as_mut()
    }
}

/// One of the independent streams of random numbers of a seed.
pub(crate) fn stream(seed: u64, stream: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(stream);
    rng
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;

    #[test]
    fn what_follows_a_drawn_start_does_not_depend_on_it() {
        let draw = |start| {
            let mut draws = Draws::new(EpisodeSeed { scene: 4, start }, 1);
            let first: f64 = draws.scene().random();
            let place: f64 = draws.start(|rng| rng.random());
            (first, place, draws.scene().random::<f64>())
        };
        let (own, other) = (draw(4), draw(6));
        assert_eq!((own.0, own.2), (other.0, other.2));
        assert_ne!(own.1, other.1);
        // The own start is the plain stream of the scene's seed.
        let mut plain = stream(4, 1);
        assert_eq!(own, (plain.random(), plain.random(), plain.random()));
    }

    #[test]
    fn starts_of_other_scenes_are_other_starts() {
        let draw = |scene| {
            let mut draws = Draws::new(EpisodeSeed { scene, start: 8 }, 0);
            draws.start(RngExt::random::<f64>)
        };
        assert_ne!(draw(2), draw(4));
    }
}
