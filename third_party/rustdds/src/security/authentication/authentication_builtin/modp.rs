//! The key agreement DH+MODP-2048-256: Diffie-Hellman in the 2048-bit MODP group
//! with a prime-order subgroup of 256 bits (RFC 5114, section 2.3). It was done
//! by OpenSSL, which no other part of this crate needs.

use bytes::Bytes;
use crypto_bigint::{modular::ConstMontyForm, Encoding, U2048, U256};
use ring::rand::SecureRandom;

use crate::{
  create_security_error_and_log,
  security::{SecurityError, SecurityResult},
};

crypto_bigint::const_monty_params!(
  Modulus,
  U2048,
  "87A8E61DB4B6663CFFBBD19C651959998CEEF608660DD0F25D2CEED4435E3B00\
   E00DF8F1D61957D4FAF7DF4561B2AA3016C3D91134096FAA3BF4296D830E9A7C\
   209E0C6497517ABD5A8A9D306BCF67ED91F9E6725B4758C022E0B1EF4275BF7B\
   6C5BFC11D45F9088B941F54EB1E59BB8BC39A0BF12307F5C4FDB70C581B23F76\
   B63ACAE1CAA6B7902D52526735488A0EF13C6D9A51BFA4AB3AD8347796524D8E\
   F6A167B5A41825D967E144E5140564251CCACB83E6B486F6B3CA3F7971506026\
   C0B857F689962856DED4010ABD0BE621C3A3960A54E710C375F26375D7014103\
   A4B54330C198AF126116D2276E11715F693877FAD7EF09CADB094AE91E1A1597"
);

type Element = ConstMontyForm<Modulus, { U2048::LIMBS }>;

const GENERATOR: U2048 = U2048::from_be_hex(
  "3FB32C9B73134D0B2E77506660EDBD484CA7B18F21EF205407F4793A1A0BA125\
   10DBC15077BE463FFF4FED4AAC0BB555BE3A6C1B0C6B47B1BC3773BF7E8C6F62\
   901228F8C28CBB18A55AE31341000A650196F931C77A57F2DDF463E5E9EC144B\
   777DE62AAAB8A8628AC376D282D6ED3864E67982428EBC831D14348F6F2F9193\
   B5045AF2767164E1DFC967C1FB3F2E55A4BD1BFFE83B9C80D052B985D182EA0A\
   DB2A3B7313D3FE14C8484B1E052588B9B7D2BBD2DF016199ECD06E1557CD0915\
   B3353BBB64E0EC377FD028370DF92B52C7891428CDC67EB6184B523D1DB246C3\
   2F63078490F00EF8D647D148D47954515E2327CFEF98C582664B4C0F6CC41659",
);

/// Order of the subgroup.
const ORDER: U256 =
  U256::from_be_hex("8CF83642A709A097B447997640129DA299B1A47D1EB3750BA308B0FE64F5FBD3");

const MODULUS_BYTES: usize = 256;

/// A private key, used once.
pub(crate) struct ModpKey(U256);

impl ModpKey {
  pub(super) fn generate(random: &dyn SecureRandom) -> SecurityResult<Self> {
    let mut bytes = [0u8; 32];
    random.fill(&mut bytes)?;
    Ok(Self(U256::from_be_bytes(bytes.into())))
  }

  /// The public key, big-endian, without leading zeros.
  pub(super) fn public_key(&self) -> Bytes {
    significant(&Element::new(&GENERATOR).pow(&self.0).retrieve())
  }

  /// What both have in common then, big-endian, without leading zeros. A public
  /// key outside of the subgroup is refused, as it would tell about the private one.
  pub(super) fn shared_secret(&self, remote_public_key: &[u8]) -> SecurityResult<Bytes> {
    let refused = || create_security_error_and_log!("Not a public key of DH+MODP-2048-256");
    let leading_zeros = remote_public_key.iter().take_while(|b| **b == 0).count();
    let given = &remote_public_key[leading_zeros..];
    if given.len() > MODULUS_BYTES {
      return Err(refused());
    }
    let mut padded = [0u8; MODULUS_BYTES];
    padded[MODULUS_BYTES - given.len()..].copy_from_slice(given);
    let integer = U2048::from_be_slice(&padded);
    let element = Element::new(&integer);
    let is_reduced = element.retrieve() == integer;
    let in_subgroup = element.pow(&ORDER).retrieve() == U2048::ONE;
    if !is_reduced || !in_subgroup || integer <= U2048::ONE {
      return Err(refused());
    }
    Ok(significant(&element.pow(&self.0).retrieve()))
  }
}

fn significant(integer: &U2048) -> Bytes {
  let bytes = integer.to_be_bytes();
  let bytes: &[u8] = bytes.as_ref();
  let leading_zeros = bytes.iter().take_while(|b| **b == 0).count();
  Bytes::copy_from_slice(&bytes[leading_zeros..])
}

#[cfg(test)]
mod tests {
  use super::*;
  use crate::security::authentication::Sha256;

  /// `openssl genpkey -paramfile` twice with `dh_rfc5114:3`, then `openssl
  /// pkeyutl -derive`.
  #[test]
  fn the_secret_is_that_of_openssl() {
    let key = ModpKey(U256::from_be_hex(
      "00000000c6071eda4fea420bb1087c316da75a8ec7d53d4e1f662cdcdc2bd8c0",
    ));
    let remote = U2048::from_be_hex(
      "248a0304b88a582db0cb0be07cd12f5664d621c7e0f220ec39a33dacb1ffb814\
       a42b9c6255df46a510388dbe02982652731ca086f2dc72fbe8f70202046a614b\
       12abe5ffef1847efb14872df8656316d561e77d37aa4b6d12ee68a53f63727a0\
       36b45933dc9b462754deca46b2ec7df391bf52907b898fb0e6bf6a503a106498\
       ef46cc7ac0f1550cb3761ccdcf7f0d329210928f74f07f4d83c8d50997c9ecc7\
       fc12ffa479013a19e5bd94cf79b3116f6f9f8b16f87d128da90fa4bcbfe7ced6\
       22f5dd927f71b94b8385ea8a9267940fba8a498679a4f35845e3abc036ada8cb\
       6615f2540b9831bc088293f6d600577fdcaf52317098752202a5a884d5be8926",
    );
    let secret = key.shared_secret(&significant(&remote)).unwrap();
    let hash = Sha256::hash(&secret);
    let hex: String = hash.as_ref().iter().map(|b| format!("{b:02x}")).collect();
    assert_eq!(
      hex,
      "4488a4dd2f4b83b6364a6a495cb4054733e6f5868e1bdb491040c967efd80997"
    );
  }

  #[test]
  fn both_find_the_same_secret() {
    let random = ring::rand::SystemRandom::new();
    let one = ModpKey::generate(&random).unwrap();
    let other = ModpKey::generate(&random).unwrap();
    assert_eq!(
      one.shared_secret(&other.public_key()).unwrap(),
      other.shared_secret(&one.public_key()).unwrap()
    );
  }

  #[test]
  fn what_is_outside_of_the_subgroup_is_refused() {
    let key = ModpKey(U256::from_u8(5));
    let minus_one = Element::new(&U2048::ONE).neg().retrieve();
    for outside in [U2048::ZERO, U2048::ONE, U2048::from_u8(2), minus_one] {
      assert!(key.shared_secret(&significant(&outside)).is_err());
    }
    assert!(key.shared_secret(&[1; MODULUS_BYTES + 1]).is_err());
  }
}
