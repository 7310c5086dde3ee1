// SPDX-License-Identifier: Apache-2.0
/// @file What every call into Aravis needs: owners of its objects, and its complaints.
#pragma once

#include <arv.h>

#include <algorithm>
#include <cctype>
#include <memory>
#include <string>

#include "omnister/common/error.h"

namespace omnister::device {

struct Unref {
  void operator()(gpointer object) const { g_object_unref(object); }
};
template <typename T>
using Object = std::unique_ptr<T, Unref>;

/// What a call into Aravis complained of.
class Failure {
 public:
  Failure() = default;
  ~Failure() { g_clear_error(&error_); }
  Failure(const Failure&) = delete;
  Failure& operator=(const Failure&) = delete;
  GError** out() {
    g_clear_error(&error_);
    return &error_;
  }
  explicit operator bool() const { return error_ != nullptr; }
  bool is(int code) const {
    return error_ && error_->domain == ARV_DEVICE_ERROR && error_->code == code;
  }
  std::string text() const { return error_ ? printable(error_->message) : ""; }

 private:
  GError* error_ = nullptr;
};

inline std::string string(const char* text) { return text ? text : ""; }

inline std::string lower(std::string text) {
  std::transform(text.begin(), text.end(), text.begin(),
                 [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
  return text;
}

/// What g_free() frees.
using Names = std::unique_ptr<const char*, decltype(&g_free)>;

}  // namespace omnister::device
