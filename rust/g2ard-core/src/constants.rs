//! Structs of constants, which Python reads and sets by name.

/// The location of one constant's value.
#[derive(Debug)]
pub enum Slot<'a> {
    F64(&'a mut f64),
    F32(&'a mut f32),
    Count(&'a mut usize),
    Flag(&'a mut bool),
}

macro_rules! slots {
    ($($kind:ty => $slot:ident),*) => {$(
        impl<'a> From<&'a mut $kind> for Slot<'a> {
            fn from(value: &'a mut $kind) -> Self {
                Self::$slot(value)
            }
        }
    )*};
}

slots!(f64 => F64, f32 => F32, usize => Count, bool => Flag);

/// A struct declared by `constants!`.
pub trait Constants: Default {
    /// Return every field's name and place.
    fn slots(&mut self) -> Vec<(&'static str, Slot<'_>)>;
}

/// Declare a struct of constants, each with its default. Bindings need no list of the fields: they go by
/// [`Constants::slots`].
macro_rules! constants {
    ($(#[$about:meta])* pub struct $Name:ident {
        $($(#[$doc:meta])* pub $field:ident: $kind:ty = $default:expr,)*
    }) => {
        $(#[$about])*
        #[derive(Debug, Clone, Copy, PartialEq)]
        pub struct $Name {
            $($(#[$doc])* pub $field: $kind,)*
        }

        impl Default for $Name {
            fn default() -> Self {
                Self { $($field: $default,)* }
            }
        }

        impl $crate::constants::Constants for $Name {
            fn slots(&mut self) -> Vec<(&'static str, $crate::constants::Slot<'_>)> {
                vec![$((stringify!($field), (&mut self.$field).into())),*]
            }
        }
    };
}

pub(crate) use constants;
