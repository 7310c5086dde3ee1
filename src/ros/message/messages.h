// SPDX-License-Identifier: Apache-2.0
/// @file The package's own messages. Include this one and never the generated omnister/LensModel.h:
/// the message and the class of the core would both be omnister::LensModel, so the message is
/// called omnister::LensModelMessage in this package's code (on the wire it stays
/// omnister/LensModel).
#pragma once

#include <omnister/StageState.h>

#define LensModel LensModelMessage
#include <omnister/LensModel.h>
#undef LensModel
