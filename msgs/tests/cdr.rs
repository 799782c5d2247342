//! Every type against bytes of another implementation, and against itself.

use msgs::{Interface, Visitor, from_cdr, to_cdr};
use proptest::prelude::*;
use serde::de::{self, DeserializeSeed, SeqAccess};
use std::collections::BTreeMap;
use std::fmt;

/// Makes a value of any type by counting. The rule is that of `golden/make.py`.
struct Filler {
    count: u64,
    /// Elements of a sequence.
    most: u64,
}

impl Filler {
    fn next(&mut self) -> u64 {
        self.count = self.count.wrapping_add(1);
        self.count
    }

    fn bits(&mut self, bits: u32) -> u64 {
        self.next().wrapping_mul(0x9E37_79B9_7F4A_7C15) >> (64 - bits)
    }

    fn fill<T: Interface>(start: u64) -> T {
        let fill = |most| T::deserialize(&mut Filler { count: start, most });
        // A type with a bounded sequence takes no more.
        fill(3).or_else(|_| fill(1)).unwrap()
    }
}

#[derive(Debug)]
struct Unused;

impl fmt::Display for Unused {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("unused")
    }
}
impl std::error::Error for Unused {}
impl de::Error for Unused {
    fn custom<T: fmt::Display>(_: T) -> Self {
        Self
    }
}

struct Elements<'a> {
    filler: &'a mut Filler,
    left: usize,
}

impl<'de> SeqAccess<'de> for Elements<'_> {
    type Error = Unused;

    fn next_element_seed<T: DeserializeSeed<'de>>(
        &mut self,
        seed: T,
    ) -> Result<Option<T::Value>, Unused> {
        if self.left == 0 {
            return Ok(None);
        }
        self.left -= 1;
        seed.deserialize(&mut *self.filler).map(Some)
    }
}

macro_rules! integers {
    ($($method:ident $visit:ident $type:ty,)*) => {
        $(fn $method<V: de::Visitor<'de>>(self, visitor: V) -> Result<V::Value, Unused> {
            visitor.$visit(self.bits(<$type>::BITS) as $type)
        })*
    };
}

impl<'de> de::Deserializer<'de> for &mut Filler {
    type Error = Unused;

    integers! {
        deserialize_i8 visit_i8 i8, deserialize_i16 visit_i16 i16,
        deserialize_i32 visit_i32 i32, deserialize_i64 visit_i64 i64,
        deserialize_u8 visit_u8 u8, deserialize_u16 visit_u16 u16,
        deserialize_u32 visit_u32 u32, deserialize_u64 visit_u64 u64,
    }

    fn deserialize_any<V: de::Visitor<'de>>(self, _: V) -> Result<V::Value, Unused> {
        panic!("a kind of type that ROS does not have")
    }

    fn deserialize_bool<V: de::Visitor<'de>>(self, visitor: V) -> Result<V::Value, Unused> {
        visitor.visit_bool(self.next().is_multiple_of(2))
    }

    fn deserialize_f32<V: de::Visitor<'de>>(self, visitor: V) -> Result<V::Value, Unused> {
        visitor.visit_f32(self.next() as f32 * 0.5)
    }

    fn deserialize_f64<V: de::Visitor<'de>>(self, visitor: V) -> Result<V::Value, Unused> {
        visitor.visit_f64(self.next() as f64 * 0.5)
    }

    fn deserialize_string<V: de::Visitor<'de>>(self, visitor: V) -> Result<V::Value, Unused> {
        visitor.visit_string(format!("s{}", self.next()))
    }

    fn deserialize_byte_buf<V: de::Visitor<'de>>(self, visitor: V) -> Result<V::Value, Unused> {
        let size = self.next() % 4;
        visitor.visit_byte_buf(
            (0..size)
                .map(|index| self.count.wrapping_add(index) as u8)
                .collect(),
        )
    }

    fn deserialize_seq<V: de::Visitor<'de>>(self, visitor: V) -> Result<V::Value, Unused> {
        let left = (self.next() % (self.most + 1)) as usize;
        visitor.visit_seq(Elements { filler: self, left })
    }

    fn deserialize_tuple<V: de::Visitor<'de>>(
        self,
        left: usize,
        visitor: V,
    ) -> Result<V::Value, Unused> {
        visitor.visit_seq(Elements { filler: self, left })
    }

    fn deserialize_struct<V: de::Visitor<'de>>(
        self,
        _: &'static str,
        fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, Unused> {
        self.deserialize_tuple(fields.len(), visitor)
    }

    serde::forward_to_deserialize_any! {
        i128 u128 char str bytes option unit unit_struct newtype_struct tuple_struct map enum identifier ignored_any
    }
}

#[test]
fn every_type_has_the_bytes_of_another_implementation() {
    struct Compare {
        golden: BTreeMap<&'static str, &'static str>,
    }
    impl Visitor for Compare {
        fn visit<T: Interface>(&mut self) {
            let golden = self
                .golden
                .remove(T::TYPE_NAME)
                .unwrap_or_else(|| panic!("no golden for {}", T::TYPE_NAME));
            let value = Filler::fill::<T>(0);
            let hexadecimal: String = to_cdr(&value)
                .unwrap()
                .iter()
                .map(|byte| format!("{byte:02x}"))
                .collect();
            assert_eq!(hexadecimal, golden, "{}", T::TYPE_NAME);
        }
    }
    let golden = include_str!("golden/cdr.txt")
        .lines()
        .map(|line| line.split_once(' ').unwrap())
        .collect();
    let mut compare = Compare { golden };
    msgs::visit_all(&mut compare);
    assert_eq!(compare.golden, BTreeMap::new(), "goldens without a type");
}

proptest! {
    #[test]
    fn every_type_is_read_back(start: u64) {
        struct RoundTrip(u64);
        impl Visitor for RoundTrip {
            fn visit<T: Interface>(&mut self) {
                let value = Filler::fill::<T>(self.0);
                assert_eq!(from_cdr::<T>(&to_cdr(&value).unwrap()).unwrap(), value);
            }
        }
        msgs::visit_all(&mut RoundTrip(start));
    }

    #[test]
    fn cut_and_random_bytes_are_errors_or_messages_but_never_panics(
        start: u64,
        cut: prop::sample::Index,
        noise in prop::collection::vec(any::<u8>(), 0..200),
    ) {
        struct Hostile(u64, prop::sample::Index, Vec<u8>);
        impl Visitor for Hostile {
            fn visit<T: Interface>(&mut self) {
                let bytes = to_cdr(&Filler::fill::<T>(self.0)).unwrap();
                let cut = &bytes[..self.1.index(bytes.len())];
                assert!(from_cdr::<T>(cut).is_err(), "{} from {} of {} bytes", T::TYPE_NAME, cut.len(), bytes.len());
                let mut noisy = vec![0, 1, 0, 0];
                noisy.extend(&self.2);
                let _ = from_cdr::<T>(&noisy);
            }
        }
        msgs::visit_all(&mut Hostile(start, cut, noise));
    }
}

#[test]
fn a_wrong_header_a_length_beyond_the_data_and_left_over_bytes_are_refused() {
    use msgs::std_msgs::String as Text;
    let good = to_cdr(&Text { data: "abc".into() }).unwrap();
    let refusal = |bytes: &[u8]| from_cdr::<Text>(bytes).unwrap_err().to_string();
    assert_eq!(
        refusal(&good[..3]),
        "3 bytes, expected at least the 4 of the CDR header"
    );
    let mut xcdr2 = good.clone();
    xcdr2[1] = 7;
    assert_eq!(
        refusal(&xcdr2),
        "representation 0x0007, expected CDR_BE (0x0000) or CDR_LE (0x0001)"
    );
    let mut absurd = good.clone();
    absurd[4..8].copy_from_slice(&u32::MAX.to_le_bytes());
    refusal(&absurd);
    let mut long = good.clone();
    long.extend([0; 8]);
    assert_eq!(refusal(&long), "8 bytes left over after a message of 12");
    long.truncate(good.len() + 3);
    assert_eq!(from_cdr::<Text>(&long).unwrap().data, "abc");
}

#[test]
fn big_endian_messages_are_read() {
    let bytes = [0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 2];
    let time: msgs::builtin_interfaces::Time = from_cdr(&bytes).unwrap();
    assert_eq!(time, msgs::builtin_interfaces::Time { sec: 1, nanosec: 2 });
}

#[test]
fn default_values_are_those_of_the_files() {
    assert_eq!(msgs::geometry_msgs::Quaternion::default().w, 1.0);
    assert_eq!(msgs::sensor_msgs::CameraInfo::default().k, [0.0; 9]);
}
