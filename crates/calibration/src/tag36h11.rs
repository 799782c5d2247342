//! The tag family tag36h11 (Olson, "AprilTag: a robust and flexible visual fiducial system", 2011), its first codes.

/// Modules along an edge of a tag with its black border; the code has 6 x 6 of them.
pub(crate) const MODULES: usize = 8;

/// Codes by id, the first bit in [`BITS`] highest. As every library of AprilTags has them.
pub(crate) const CODES: [u64; 24] = [
    0xd7e00984b,
    0xdda664ca7,
    0xdc4a1c821,
    0xe17b470e9,
    0xef91d01b1,
    0xf429cdd73,
    0x05da29225,
    0x1106cba43,
    0x223bed79d,
    0x21f51213c,
    0x33eb19ca6,
    0x3f76eb0f8,
    0x469a97414,
    0x45dcfe0b0,
    0x4a6465f72,
    0x51801db96,
    0x5eb946b4e,
    0x68a7cc2ec,
    0x6f0ba2652,
    0x78765559d,
    0x87b83d129,
    0x86cc4a5c5,
    0x8b64df90f,
    0x9c577b611,
];

/// Column and row of each bit, counted in modules from the upper left corner of the border.
const BITS: [(usize, usize); 36] = [
    (1, 1),
    (2, 1),
    (3, 1),
    (4, 1),
    (5, 1),
    (2, 2),
    (3, 2),
    (4, 2),
    (3, 3),
    (6, 1),
    (6, 2),
    (6, 3),
    (6, 4),
    (6, 5),
    (5, 2),
    (5, 3),
    (5, 4),
    (4, 3),
    (6, 6),
    (5, 6),
    (4, 6),
    (3, 6),
    (2, 6),
    (5, 5),
    (4, 5),
    (3, 5),
    (4, 4),
    (1, 6),
    (1, 5),
    (1, 4),
    (1, 3),
    (1, 2),
    (2, 5),
    (2, 4),
    (2, 3),
    (3, 4),
];

/// Bits that may be wrong in a code that is read.
const MOST_WRONG: u32 = 2;

/// Whether a module of a tag is white, by column and row from the upper left corner of its border.
pub(crate) fn is_white(id: usize, col: usize, row: usize) -> bool {
    let bit = BITS.iter().position(|at| *at == (col, row));
    bit.is_some_and(|bit| CODES[id] >> (35 - bit) & 1 == 1)
}

/// The tag whose modules these are, and by how many quarter turns (clockwise, as seen) it is turned. `white` tells of a module by column and row.
pub(crate) fn decode(white: impl Fn(usize, usize) -> bool) -> Option<(usize, usize)> {
    (0..4).find_map(|turns| {
        let code = BITS.iter().fold(0u64, |code, (col, row)| {
            let (mut col, mut row) = (*col, *row);
            for _ in 0..turns {
                (col, row) = (MODULES - 1 - row, col);
            }
            code << 1 | u64::from(white(col, row))
        });
        let wrong = |known: &u64| (known ^ code).count_ones();
        let id = (0..CODES.len()).find(|id| wrong(&CODES[*id]) <= MOST_WRONG)?;
        Some((id, turns))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn turned(id: usize, turns: usize) -> impl Fn(usize, usize) -> bool {
        move |mut col, mut row| {
            for _ in 0..turns {
                (col, row) = (row, MODULES - 1 - col);
            }
            is_white(id, col, row)
        }
    }

    #[test]
    fn the_family_keeps_its_distance_of_11_bits_in_every_orientation() {
        let code = |id, turns| {
            let white = turned(id, turns);
            BITS.iter().fold(0u64, |code, (col, row)| {
                code << 1 | u64::from(white(*col, *row))
            })
        };
        for a in 0..CODES.len() {
            for b in 0..CODES.len() {
                for turns in 0..4 {
                    let apart = (code(a, 0) ^ code(b, turns)).count_ones();
                    assert!(
                        (a, 0) == (b, turns) || apart >= 11,
                        "{a} {b} {turns}: {apart}"
                    );
                }
            }
        }
    }

    #[test]
    fn tags_are_read_in_every_orientation_and_with_two_wrong_bits() {
        for id in 0..CODES.len() {
            for turns in 0..4 {
                let white = turned(id, turns);
                assert_eq!(decode(&white), Some((id, turns)));
                let spoilt =
                    |col, row| white(col, row) ^ ((col, row) == (3, 3) || (col, row) == (6, 2));
                assert_eq!(decode(spoilt), Some((id, turns)));
            }
        }
        assert_eq!(decode(|_, _| false), None);
    }
}
